"""The compiled kernels of `xrgs/csrc` as torch operations, for float32 on the CPU."""
