"""LPIPS, version 0.1, with AlexNet: the network, its published weights, and their download."""
