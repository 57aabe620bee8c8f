"""xrgs: does this change to 3D Gaussian Splatting really help?

An experiment harness: it builds mixed-resolution variants of multi-view scenes, trains 3D Gaussian
Splatting and the ablations of Cross-Resolution Gaussian Splatting on the CPU, and reports
percentage-change tables.
"""

__version__ = "0.1.0"
