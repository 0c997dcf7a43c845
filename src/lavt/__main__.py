"""Run `lavt` as `python -m lavt`."""

from lavt.cli.main import main

main()
