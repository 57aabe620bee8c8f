"""Strategies of densification: what grows, prunes and resets Gaussians during training.

`base.Strategy` is what the training loop calls. `default.DefaultStrategy` is gsplat's default.
`refinement` has what a strategy is told and what it reports, `ops` what strategies share.
"""
