"""The renderer of gsplat on a GPU; the other operations of this backend are `xrgs/splat/torch`."""
