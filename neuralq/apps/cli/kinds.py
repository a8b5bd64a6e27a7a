"""``neuralq train NAME`` and ``neuralq resume`` for kinds of runs that have options of their own."""

from __future__ import annotations

import argparse
import contextlib
import re
import signal
import sys
from collections.abc import Callable, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import NoneType
from typing import Any, get_args, get_type_hints

from neuralq.apps.cli import Failure, print_result
from neuralq.apps.cli.option_table import add_fields
from neuralq.apps.cli.option_values import as_typed, hyphenated, read_config_file, read_options, reader
from neuralq.apps.cli.progress import training_bar
from neuralq.checks import MissingExtra
from neuralq.runs.folder.run_folder import claimed, read_config, refuse_old_run
from neuralq.runs.kinds import KINDS, CommandLine, Kind, Result, kind_in, kind_named
from neuralq.runs.report import write_report

__all__ = ["changes_of", "conclude", "measured_by", "new_budget", "resume_kind", "say", "train_kind"]


def say(line: str) -> None:
    """A line beside the result, for whoever watches; where the terminal has gone or the disk is full, for nobody."""
    with contextlib.suppress(OSError):
        print(f"neuralq: {line}", file=sys.stderr, flush=True)


def conclude(run: Result, as_json: bool, notes: Sequence[str] = (), **more: Any) -> int:
    """Prints the result of a run; the exit status says whether a signal ended it."""
    plain, report = run.plain() | more, more.get("report")
    signal_name, folder = plain["interrupted_by"], plain["run_dir"]
    if signal_name is not None:
        say(f"{signal_name}: saved at {plain['env_steps']:,} steps; go on with: neuralq resume {folder}")
    lines = [*run.lines(), f"run folder {folder}" + ("" if report is None else f", report {report}")]
    print_result(plain, as_json, [*lines, *notes])
    return 0 if signal_name is None else 128 + signal.Signals[signal_name].value


def reported(run: Result, film: Callable[[Path], Sequence[tuple[bytes, str]]] | None = None) -> str | None:
    """The page of a run, written; None where there is nothing to draw with, which is said."""
    folder = Path(run.plain()["run_dir"])
    try:
        return str(write_report(folder, () if film is None else film(folder)))
    except MissingExtra as error:
        say(f"no report: {error}")
        return None


def train_kind(name: str, argv: Sequence[str]) -> int:
    """Train as the options of this kind of run say."""
    kind = kind_named(name)
    parser = _parser(kind)
    if {"-h", "--help"} & set(argv):
        print(as_typed(parser.format_help()))
        return 0
    given = read_options(parser, hyphenated(argv))
    as_json, run_dir = given.pop("json", False), given.pop("run_dir", None)
    config = _config(kind, given)
    with claimed(run_dir, lambda: kind.default_path(config)) as path:
        refuse_old_run(path)  # also by the run, but preparing takes seconds
        say(f"run folder {path}; preparing (the first run on a machine compiles kernels)")
        with training_bar(kind, config) as bar:
            run = kind.train(config, path, [bar])
    return conclude(run, as_json, report=reported(run) if _command(kind).report else None)


def resume_kind(name: str, options: argparse.Namespace) -> int:
    """Go on with a run, as the options of ``neuralq resume`` say."""
    kind = kind_named(name)
    for other in ("workers", "hook", "stop_at_return", "device"):
        if getattr(options, other, None) is not None:
            raise Failure(f"--{other.replace('_', '-')} is not for {kind.title} like {options.run}; leave it out", 2)
    budget, config = new_budget(kind, options), kind.from_plain(read_config(options.run))
    try:
        changes = changes_of(kind, config, options.changes)
        config = kind.changed(config, budget, changes)
    except ValueError as error:
        raise Failure(_in_options(kind, str(error)), 2) from error
    with training_bar(kind, config) as bar:
        run = kind.resume(options.run, budget, [bar], changes)
    return conclude(run, options.json, report=reported(run) if _command(kind).report else None)


def new_budget(kind: Kind[Any, Any, Any], options: argparse.Namespace) -> int | None:
    """The new budget that ``neuralq resume`` was given.

    Raises:
        Failure: if it is in what this kind of run is not counted in.
    """
    given = {"total_steps": options.total_steps, "num_games": options.games}
    for field, option in (("total_steps", "--total-steps"), ("num_games", "--games")):
        if field != kind.budget and given[field] is not None:
            raise Failure(f"{option} is not for {kind.title} like {options.run}; leave it out", 2)
    budget: int | None = given[kind.budget]
    return budget


def changes_of(kind: Kind[Any, Any, Any], config: Any, words: Sequence[str]) -> dict[str, Any]:
    """What ``--set key=value`` asks for, by full name, each value of its field's kind.

    Raises:
        ValueError: for what may not change, with what may.
        Failure: for words that are no ``key=value``, keys given twice and values of another kind, with exit status 2.
    """
    changes: dict[str, Any] = {}
    for word in words:
        key, sign, text = word.partition("=")
        if not sign:
            raise Failure(f"--set takes key=value, got {word!r}; e.g. --set {kind.budget}=100000", 2)
        name = kind.full_name(config, key.strip().replace("-", "_"))
        if name in changes:
            raise Failure(f"--set {name} is given twice; leave one out", 2)
        part, dot, field = name.partition(".")
        owner = type(getattr(config, part)) if dot else type(config)
        text, hint = text.strip(), get_type_hints(owner)[field if dot else part]
        try:
            changes[name] = None if text.lower() == "none" and NoneType in get_args(hint) else reader(hint)(text)
        except argparse.ArgumentTypeError as error:
            raise Failure(f"--set {name}: {error}", 2) from error
    return changes


def measured_by(words: Sequence[str]) -> str | None:
    """The command that evaluates what the words of a command line name or ask, if a kind of run has its own."""
    named = next(filter(None, map(kind_in, words)), None)
    for name in KINDS if named is None else [named]:
        command = kind_named(name).command
        if command is not None and (
            named or any(w.startswith(m) or w.endswith(m) for w in words for m in command.measures)
        ):
            return command.measure
    return None


def _parser(kind: Kind[Any, Any, Any]) -> argparse.ArgumentParser:
    command = _command(kind)
    parser = argparse.ArgumentParser(
        prog=f"neuralq train {kind.name}",
        usage=f"neuralq train {kind.name} [options]",
        description=command.description,
        epilog="\n  ".join(["examples:", *command.examples]),
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
        exit_on_error=False,
        argument_default=argparse.SUPPRESS,
    )
    parts = _parts(kind)
    inner = {f.name for settings in parts.values() for f in fields(settings)}
    for settings in parts.values():
        add_fields(parser, settings, short=command.short)
    add_fields(parser, kind.config, short=command.short, leave_out={*parts, *inner})
    parser.add_argument("--config", metavar="FILE", help="config.json of a run, to start from its settings")
    parser.add_argument("--run_dir", metavar="FOLDER", help="where the run goes (default: a folder under runs/)")
    parser.add_argument("--json", action="store_true", help="print the result as one JSON object on the last line")
    return parser


def _command(kind: Kind[Any, Any, Any]) -> CommandLine:
    assert kind.command is not None, f"neuralq train has options of its own for {kind.name}"
    return kind.command


def _parts(kind: Kind[Any, Any, Any]) -> dict[str, type[Any]]:
    """Fields of the configuration that are dataclasses themselves."""
    hints = get_type_hints(kind.config).items()
    return {name: hint for name, hint in hints if isinstance(hint, type) and is_dataclass(hint)}


def _config(kind: Kind[Any, Any, Any], given: dict[str, Any]) -> Any:
    """Defaults, then the file, then the command line, the later winning; "none" alone is an empty list."""
    file = given.pop("config", None)
    given = {name: [] if value == ["none"] else value for name, value in given.items()}
    try:
        plain: dict[str, Any] = (
            {"kind": kind.name} if file is None else kind.to_plain(kind.from_plain(read_config_file(file)))
        )
        for place, settings in _parts(kind).items():
            own = {f.name: given.pop(f.name) for f in fields(settings) if f.name in given}
            # What both have, a budget, is the inner one's to say: the outer one would win.
            plain = {name: value for name, value in plain.items() if name not in own}
            plain[place] = {**plain.get(place, {}), **own}
        return kind.from_plain({**plain, **given})
    except ValueError as error:
        raise Failure(_in_options(kind, str(error)), 2) from error


def _in_options(kind: Kind[Any, Any, Any], message: str) -> str:
    """Names of fields as the options that set them; those of one word are left, which may be words of the message."""
    short = _command(kind).short
    names = {f.name for settings in (kind.config, *_parts(kind).values()) for f in fields(settings) if "_" in f.name}
    return re.sub(r"\b\w+", lambda m: as_typed(f"--{short.get(m[0], m[0])}") if m[0] in names else m[0], message)
