"""Questions for which a virtual unit is played, with models that exist already."""
