"""The `lavt` command, also as `python -m lavt`."""


def main() -> None:
    """Run the command line; Ctrl-C during its import ends it without a traceback."""
    try:
        from lavt.cli.main import main as run  # noqa: PLC0415 (inside `try`)

        run()
    except KeyboardInterrupt:
        raise SystemExit(130) from None  # 128 + SIGINT, as shells report it


if __name__ == "__main__":
    main()
