"""The renderer of gsplat on a GPU; all else of this backend is `xrgs/splat/torch`."""
