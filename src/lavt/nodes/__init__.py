"""The nodes of the control loop: pipelines of stages without input, output or clock."""
