"""`fleet`: find recordings, group by vehicle, analyse in parallel, find drifts and outliers."""
