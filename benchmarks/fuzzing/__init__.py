"""What `benchmarks/fuzz.py` is made of: how inputs are damaged, and what takes them."""
