"""`python -m lavt` is `lavt`."""

from lavt.cli.main import main

main()
