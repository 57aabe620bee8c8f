"""The readable reference implementation in torch, for any floating type, with autograd."""
