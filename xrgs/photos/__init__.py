"""Turns users' photographs, videos and masks into upright sRGB images, masks and lenses."""
