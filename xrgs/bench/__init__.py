"""The benchmark `xrgs-bench`: run time against error, from small loads to large."""
