"""Secure global connectivity (chapter 8): robots, servers and people as if on one network, trusting no router.

Zenoh moves the bytes; this package gives 256-bit names, identity, end-to-end sealing, access and proxies. It stands on
its own: it imports no simulator and no learning library.
"""
