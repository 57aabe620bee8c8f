"""LPIPS: the network, and its published weights."""
