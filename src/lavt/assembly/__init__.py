"""Objects made of configs: the only floor that sees both."""
