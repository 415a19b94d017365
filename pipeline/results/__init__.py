"""Results on disk: the tables of each run, the catalogue over all of them, and SQL over both."""
