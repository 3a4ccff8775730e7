"""Many sequences for `handtrack track`: over processes of this machine, or over a Dask cluster.

Both go through joblib, with the same task. A task writes its results file by file, each replaced as
a whole, so one that is run again, because its worker died, leaves the same results once.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, cast

from handtrack.cli.track import TrackOptions
from handtrack.errors import HandtrackError, InputError
from handtrack.optional import import_extra

DONE, SKIPPED, FAILED, INTERRUPTED = "done", "skipped", "failed", "interrupted"

_DEATHS = ("TerminatedWorkerError", "BrokenProcessPool", "KilledWorker")
"""Errors by which joblib's processes and Dask say that a worker died, the latter after it gave the
task to several."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """One sequence to be tracked."""

    name: str
    """Name of the sequence among the others, and of its folder below --out."""
    source: str
    """What to open."""
    out: Path
    """Folder for its results."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """What became of a task."""

    name: str
    """The task's name."""
    state: Literal["done", "skipped", "failed", "interrupted"]
    """How it ended; skipped: its results were there."""
    problem: str = ""
    """Why it failed, in one line."""
    frames: int = 0
    """Frames that were tracked."""
    found: int = 0
    """Frames among them whose hand was found."""
    depth_error_mm: float = float("nan")
    """Median depth error [mm]."""


def track_many(options: TrackOptions) -> int:
    """Track all sequences, print a table, and tell failures at the end.

    Args:
        options: The command's options.

    Returns:
        Exit code: 0, 1 when a sequence failed, or 130 when it was interrupted.

    Raises:
        HandtrackError: An option does not go with several sequences, or the cluster is not there.
    """
    from handtrack import cli
    from handtrack.cli.progress import counting

    if options.record is not None:
        raise InputError("--record goes with one source: record one after the other")
    if options.out.exists() and not options.out.is_dir():
        raise InputError(f"{options.out} is a file: expected a folder for the results")
    tasks = make_tasks(options)
    outcomes: dict[str, Outcome] = {}
    with counting(len(tasks), "tracking") as count, ExitStack() as stack:
        runner = _Runner(options, stack)
        for outcome in runner.run(tasks):
            outcomes[outcome.name] = outcome
            count(len(outcomes), "tracking")
            if outcome.state == INTERRUPTED:
                break
    found = [outcomes[task.name] for task in tasks if task.name in outcomes]
    _print_table(options, found)
    states = {outcome.state for outcome in found}
    if INTERRUPTED in states:
        return cli.INTERRUPTED
    return cli.FAILURE if FAILED in states else 0


def make_tasks(options: TrackOptions) -> list[Task]:
    """A task for each source; folders are named after sources, with as much as tells them apart.

    Raises:
        InputError: A source is live, or named twice.
    """
    from handtrack.camera.source import LIVE_SOURCES

    for source in options.source:
        if source.partition(":")[0] in LIVE_SOURCES:
            raise InputError(f"{source} is live: it is tracked alone, without --jobs and --dask")
    # Other machines have other current folders.
    paths = [Path(source).expanduser().resolve() for source in options.source]
    if len(set(paths)) < len(paths):
        twice = next(path for path in paths if paths.count(path) > 1)
        raise InputError(f"{twice} is named twice")
    out = options.out.expanduser().resolve()
    names = _distinct(paths)
    return [
        Task(name=name, source=str(path), out=out / name)
        for name, path in zip(names, paths, strict=True)
    ]


def run_task(options: TrackOptions, task: Task) -> Outcome:
    """Track one sequence; whatever goes wrong with it is in the outcome."""
    import numpy as np

    from handtrack.cli.track_sequence import is_done, track_sequence

    if options.resume and is_done(options, task.source, task.out):
        return Outcome(name=task.name, state=SKIPPED)
    try:
        tracked = track_sequence(options, task.source, task.out, bar=False)
    except Exception as error:  # also a mistake of ours must not stop the others
        return _failed(task, error)
    record, errors = tracked.record, tracked.record.depth_errors
    return Outcome(
        name=task.name, state=INTERRUPTED if tracked.interrupted else DONE,
        frames=len(record), found=sum(result.state.sure for result in record.results),
        depth_error_mm=1e3 * float(np.nanmedian(errors)) if np.isfinite(errors).any() else np.nan,
    )  # fmt: skip


class _Runner:
    """Runs tasks through joblib, past workers that die.

    Args:
        options: The command's options.
        stack: Keeps the connection to the cluster.

    Raises:
        InputError: There is no scheduler at the address.
        MissingDependencyError: Dask is not installed.
    """

    def __init__(self, options: TrackOptions, stack: ExitStack) -> None:
        self._options = options
        self._how: dict[str, Any] = {"n_jobs": options.jobs}
        if options.dask is not None:
            stack.enter_context(_cluster(options.dask))
            # As many tasks at a time as the cluster has threads.
            self._how = {"n_jobs": -1}

    def run(self, tasks: Sequence[Task]) -> Iterator[Outcome]:
        """Outcomes in the order in which tasks end."""
        waiting = {task.name: task for task in tasks}
        deaths = 0
        while waiting:
            alone = deaths > 0
            try:
                for outcome in self._together(list(waiting.values()), alone):
                    waiting.pop(outcome.name)
                    yield outcome
            except Exception as error:  # a worker died: joblib gives up all tasks with it
                if type(error).__name__ not in _DEATHS:
                    raise
                deaths += 1
                if alone:
                    # One at a time, in order: it is the first that waits.
                    name = next(iter(waiting))
                    yield _failed(waiting.pop(name), error)

    def _together(self, tasks: list[Task], alone: bool) -> Iterator[Outcome]:
        """Run tasks at once; after a death one by one, which tells the one that is at fault."""
        from joblib import Parallel, delayed

        # What was written before the death need not be done again.
        options = replace(self._options, resume=True) if alone else self._options
        for batch in [[task] for task in tasks] if alone else [tasks]:
            parallel: Any = Parallel(
                **self._how, batch_size=cast("Any", 1), return_as="generator_unordered"
            )
            yield from parallel(delayed(run_task)(options, task) for task in batch)


@contextmanager
def _cluster(address: str) -> Iterator[None]:
    """Let joblib work on the cluster of a Dask scheduler."""
    distributed = import_extra("distributed", "cluster", "--dask")
    try:
        client = distributed.Client(address, timeout="5s", set_as_default=False)
    except (OSError, ValueError) as error:  # time-outs are OSErrors
        raise InputError(
            f"no Dask scheduler answers at {address} ({' '.join(str(error).split())}): start one "
            "with dask scheduler, and workers with dask worker ADDRESS"
        ) from error
    from joblib import parallel_config

    with client, parallel_config(backend="dask", client=client, wait_for_workers_timeout=30):
        yield


def _failed(task: Task, error: Exception) -> Outcome:
    """A task that failed, with its reason in one line."""
    told = " ".join(str(error).split())
    if type(error).__name__ in _DEATHS:
        problem = "its process was killed or crashed, each time it was tried"
    elif isinstance(error, HandtrackError):
        problem = told
    else:
        problem = f"unexpected {type(error).__name__}: {told}"
    return Outcome(name=task.name, state=FAILED, problem=problem)


def _distinct(paths: Sequence[Path]) -> list[str]:
    """Names for paths: their last parts, as many as make all names different."""
    bare = [path.with_suffix("") if path.is_file() else path for path in paths]
    for kept in (bare, paths):
        for depth in range(1, max(len(path.parts) for path in kept)):
            names = ["_".join(path.relative_to(path.anchor).parts[-depth:]) for path in kept]
            if len(set(names)) == len(names):
                return names
    return [f"{place:03d}_{path.name}" for place, path in enumerate(paths)]


def _print_table(options: TrackOptions, outcomes: Sequence[Outcome]) -> None:
    """A line for each sequence, then what failed and why."""
    from rich.console import Console

    from handtrack.evaluation.report import terminal_table

    rows = [
        [outcome.name, outcome.state, *(
            [str(outcome.frames), str(outcome.found), f"{outcome.depth_error_mm:.2f}"]
            if outcome.frames else ["", "", ""]
        )]
        for outcome in outcomes
    ]  # fmt: skip
    console = Console(soft_wrap=True, highlight=False)
    header = ["sequence", "result", "frames", "found", "depth error, median [mm]"]
    console.print(terminal_table("", header, rows))
    failed = [outcome for outcome in outcomes if outcome.state == FAILED]
    if failed:
        console.print(f"{len(failed)} of {len(outcomes)} sequences failed:", markup=False)
        for outcome in failed:
            console.print(f"  {outcome.name}: {outcome.problem}", markup=False)
    console.print(f"written to {options.out}", markup=False)
