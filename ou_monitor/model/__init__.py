"""Models of supply noise and load: OU, terms, likelihoods, load model; reads no files."""
