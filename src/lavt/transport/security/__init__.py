"""Signed envelopes, keys and certificates, and the gateways that verify messages from Zenoh."""
