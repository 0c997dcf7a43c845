"""What drives the nodes: the machine's time, or a virtual one."""
