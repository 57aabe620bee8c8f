"""Strategies of densification: what grows, prunes, resets and moves Gaussians during training.

`base.Strategy` is what the training loop calls. `default.DefaultStrategy` is gsplat's default, and
`mcmc.MCMCStrategy` its other one. `refinement` has what a strategy is told and what it reports,
`ops` what strategies share.
"""
