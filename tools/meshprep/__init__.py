"""Mesh preparation: read, repair, prove, draw. pymeshlab (GPL-3) is used here alone, never in the package."""


class Refused(Exception):
    """Why a mesh is not prepared: what is wrong, where, and what to do."""
