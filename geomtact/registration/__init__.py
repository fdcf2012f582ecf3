"""Refining poses: the rim of the contact is registered to the object's surface (thesis: fine registration)."""
