"""Many recordings: find -> group -> work (Dask) -> parts -> table -> statistics -> report."""
