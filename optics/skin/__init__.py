"""How the skins of touch sensors deform: the mechanics that the optics looks at."""
