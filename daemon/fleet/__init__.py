"""Many rigs: each calibrated by itself, here or on a cluster, then held against each other.

sources  where rigs are found;  assess  the work on one of them;  run  all of them, to be resumed;
comparison  what they have in common;  report, table  the result as HTML and as Parquet
"""
