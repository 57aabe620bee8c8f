"""What `xrgs-data` does: photographs and weights from elsewhere, and a look at what was made."""
