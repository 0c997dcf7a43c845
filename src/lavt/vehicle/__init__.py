"""Vehicles and their cameras."""
