"""Signed envelopes, keys and certificates, and the gateway that verifies what comes from Zenoh."""
