"""The construction of nodes, links and vehicles from configs; the packages below read no config."""
