"""The processes of `fleet.py`: light vehicles, driven vehicles with their clients, and a watcher."""
