"""Run the `lavt` command with `python -m lavt`."""

from lavt.cli.main import main

main()
