"""Many rigs: each is calibrated separately, in this process or on a cluster, then they are compared.

sources  finds the rigs;  assess  the work on one rig;  run  resumable work on all rigs;
comparison  finds common deviations and outliers;  report, table  the result as HTML and as Parquet
"""
