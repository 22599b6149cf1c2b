"""Skin: how a soft skin deforms under an indenter, by contact mechanics and by a lattice of springs."""
