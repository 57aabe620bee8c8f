"""LPIPS, version 0.1: the networks, their published weights, and their download."""
