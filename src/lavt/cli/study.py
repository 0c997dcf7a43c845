"""`lavt study`: drive a study with participants, in a balanced order of the conditions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from lavt.cli import console
from lavt.cli.progress import progress
from lavt.config import HUMAN, StudyConfig
from lavt.config_file import load_config
from lavt.errors import UserError
from lavt.recording.output_directory import disk_errors_named, reserve_directory

if TYPE_CHECKING:
    from lavt.experiment.analysis.drive_data import DriveData
    from lavt.experiment.study.answers import Store
    from lavt.experiment.study.study_plan import Block


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("study")(study)


def study(
    config: Annotated[Path, typer.Argument(help="A study config in YAML, such as configs/study.yaml.")],
    participant: Annotated[
        int | None, typer.Option(metavar="NUMBER", help="The participant who drives; default: all, for a model only.")
    ] = None,
    changes: console.SetOption = None,
    out: console.OutOption = None,
    jobs: Annotated[int | None, typer.Option(min=1, help="Number of parallel runs; default: one per core.")] = None,
    shows_plan: Annotated[bool, typer.Option("--plan", help="Print the orders of the conditions only.")] = False,
    opens_page: console.BrowserOption = True,
    port: console.PagePortOption = 0,
    asks_in_page: Annotated[
        bool, typer.Option("--questions-in-page", help="Ask a person the questions in a page, not in the terminal.")
    ] = False,
    as_json: console.JsonOption = False,
) -> None:
    """Drive a study: participants, balanced conditions, tests.

    Every participant drives all routes under all conditions: a person from a web page (controller.kind human), or a
    model of a driver. The same command continues a stopped study.

    Example: lavt study configs/study.yaml --participant 1 --out out/study
    """
    from lavt.experiment.study.balanced_order import orders_in_set  # noqa: PLC0415 (slow: scipy)
    from lavt.experiment.study.study import begin_study, drive_study, open_study, report_study  # noqa: PLC0415 (slow)
    from lavt.experiment.study.study_plan import plan_participant  # noqa: PLC0415 (slow: scipy)

    settings = load_config(StudyConfig, config, changes or [])
    participants = range(1, settings.participants + 1) if participant is None else [participant]
    blocks = [block for number in participants for block in plan_participant(settings, number)]
    if settings.participants % (orders := orders_in_set(len(settings.conditions))):
        console.print_message(
            f"lavt: {settings.participants} participants are no multiple of the {orders} orders of "
            f"{len(settings.conditions)} conditions, so the order is not balanced"
        )
    if shows_plan:
        _print_plan(blocks, as_json=as_json)
        return
    is_person = settings.controller.kind == HUMAN
    if is_person and participant is None:
        raise UserError("one person drives at a time: name the participant with --participant")
    out = out or Path("out") / "study"
    remaining = open_study(settings, blocks, out)
    failed: Sequence[tuple[str, str]] = ()
    drives: Sequence[DriveData] = ()
    with reserve_directory(out), disk_errors_named(out):
        begin_study(settings, out)
        if is_person:
            page_settings = PageSettings(port, opens_page, asks_in_page)
            _hold_session(blocks, settings.instructions, out, page_settings)
        else:
            with console.interruptible("runs"), progress(f"study, results in {out}", remaining) as report_done:
                result = drive_study(blocks, out, jobs=jobs, on_progress=report_done)
                failed, drives = result.failed, result.drives
        page = report_study(out, drives)
    console.print_report(page, out / "study.json", failed, as_json=as_json)


def _print_plan(blocks: Sequence[Block], *, as_json: bool) -> None:
    orders: dict[int, list[str]] = {}
    for block in blocks:
        orders.setdefault(block.participant, []).append(block.condition)
    if as_json:
        console.print_json(orders)
        return
    for number, order in orders.items():
        console.print_result(f"participant {number}: {', '.join(order)}")


class PageSettings(NamedTuple):
    """The port of the pages of a person (0: any), whether to open them, and whether they ask the questions."""

    port: int
    opens_page: bool
    asks_questions: bool


def _hold_session(blocks: Sequence[Block], instructions: str, out: Path, settings: PageSettings) -> None:
    """Let a person drive, with texts in the terminal, and with questions there or in a page."""
    from lavt.cli.page import show_page  # noqa: PLC0415 (only if a person drives)
    from lavt.experiment.runs.plan import PlannedRun  # noqa: PLC0415 (slow: scipy)
    from lavt.experiment.runs.real_run import PersonPage  # noqa: PLC0415 (slow: scipy)
    from lavt.experiment.runs.run import drive_once  # noqa: PLC0415 (slow: scipy)
    from lavt.experiment.study.questions_page import ask_in_page  # noqa: PLC0415 (only if a person drives)
    from lavt.experiment.study.session import Experimenter, hold_session  # noqa: PLC0415 (slow: scipy)
    from lavt.transport.console.console_link import check_installed  # noqa: PLC0415 (only if a person drives)

    check_installed()
    with TemporaryDirectory(prefix="lavt-") as work, console.interruptible():

        def show(url: str, purpose: str = "drive from") -> None:
            show_page(url, Path(work), opens_page=settings.opens_page, purpose=purpose)

        page = PersonPage(settings.port, show)

        def drive(run: PlannedRun, directory: Path) -> Mapping[str, Any]:
            return drive_once(run, directory, page=page).result

        def ask(title: str, store: Store) -> None:
            ask_in_page(title, settings.port, lambda url: show(url, "answer the questions at"), store)

        experimenter = Experimenter(console.print_message, _ask, drive, ask if settings.asks_questions else None)
        hold_session(blocks, instructions, out, experimenter)


def _ask(question: str) -> str:
    console.print_message(question)
    try:
        return input()
    except EOFError:
        raise UserError("lavt study asks questions when a person drives: start it in a terminal") from None
