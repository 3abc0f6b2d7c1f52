"""What a model leaves in a recording: integrity, innovations, lines, statistics and their null."""
