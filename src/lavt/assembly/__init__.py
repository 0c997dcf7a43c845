"""The construction of objects from configs; the layers below see no config."""
