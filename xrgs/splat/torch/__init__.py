"""The readable reference in torch, for any floating type, with gradients by autograd."""
