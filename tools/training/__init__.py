"""How the two bundled networks are trained: the shared encoder of contacts, and the contact network for tactile images."""
