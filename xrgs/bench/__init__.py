"""The benchmark of `xrgs-bench`: run time against error, training steps, skips, memory, growth."""
