"""Watching recordings and simulations side by side: a window, a browser, a film, a picture."""
