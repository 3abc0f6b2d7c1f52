"""What a simulation gets wrong: integrity -> fit -> criticise -> name -> extend -> gain."""
