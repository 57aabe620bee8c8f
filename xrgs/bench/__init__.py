"""The benchmark of `xrgs-bench`: run time, error, memory, and what each optimisation saves."""
