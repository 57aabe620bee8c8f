"""Strategies of densification, which grow, prune, reset and move Gaussians during training.

The training loop calls a `base.Strategy`: `default.DefaultStrategy` or `mcmc.MCMCStrategy`, as in
gsplat. `refinement` has the types of their inputs and results, `ops` the functions that they share.
"""
