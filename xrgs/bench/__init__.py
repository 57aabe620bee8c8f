"""Run time against error, from small loads to large: `xrgs-bench`."""
