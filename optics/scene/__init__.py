"""Scenes: what a part and an effect declare, where they are found, and how Mitsuba loads them."""
