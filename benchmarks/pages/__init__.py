"""Clients of the console's web server that are no browsers: an honest page, and hostile ones."""
