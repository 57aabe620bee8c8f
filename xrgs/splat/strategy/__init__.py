"""Strategies of densification, which grow, prune, reset and move Gaussians during training.

The training loop calls a `base.Strategy`: `default.DefaultStrategy` or `mcmc.MCMCStrategy`, as in
gsplat. `ops` has the functions that they share.
"""
