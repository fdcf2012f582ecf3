"""geomtact against other libraries, method by method in turn; see tools/peers.py."""
