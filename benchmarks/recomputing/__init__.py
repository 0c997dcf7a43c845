"""Recomputation of results from records, without LAVT."""
