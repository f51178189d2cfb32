"""Many replays, one after the other or side by side; each is saved at once, so that an interruption costs little."""

from __future__ import annotations

import hashlib
import logging
import multiprocessing
import signal
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path

import robominer_slam
from calibration.file_format import CalibrationFileError
from drivers.recording_reader import Recording, RecordingError
from robominer_slam.configuration.file import ConfigurationError
from robominer_slam.configuration.model import Configuration
from robominer_slam.configuration.overrides import Override, Variant
from robominer_slam.evaluation.run_record import DriveName, ResultsError, RunKey, RunRecord
from robominer_slam.evaluation.run_result import saved_record
from robominer_slam.evaluation.run_task import RunTask, SurfaceOf, evaluate_run
from robominer_slam.evaluation.trajectory import TrajectoryError
from robominer_slam.layout import LayoutError

log = logging.getLogger(__name__)

#: What may be wrong with a recording: one line says it. Anything else is ours and leaves a traceback in the log.
OF_THE_RECORDING = (CalibrationFileError, ConfigurationError, LayoutError, OSError, RecordingError, TrajectoryError)
RUNS = "runs"
#: Packages that decide what a replay gives, and what in them does not.
CODE = ("calibration", "drivers", "robominer_slam")
PRESENTATION = {"cli", "page", "publishing"}


@dataclass(frozen=True)
class Failure:
    """A run that could not be evaluated, and why in one line."""

    task: RunTask
    reason: str


@dataclass(frozen=True)
class Campaign:
    """What an evaluation has found.

    Attributes:
        records: of the runs, in the order of the tasks.
        files: their saved runs, in the same order.
        failures: runs that are missing.
        reused: how many were there from before.
    """

    records: list[RunRecord]
    files: list[Path]
    failures: list[Failure]
    reused: int


def plan(
    recordings: Iterable[Path],
    methods: Sequence[str],
    sources: Sequence[str],
    variants: Sequence[Variant] = (),
    common: Sequence[Override] = (),
    odometry_seeds: Sequence[int] | None = None,
) -> list[RunTask]:
    """Every recording with every source, method and variant; what cannot differ is replayed once.

    The fused odometry does not listen to the ready-made one: of recordings that differ in that one's noise alone,
    the first stands for all.

    Args:
        recordings: MCAP files.
        methods: of SLAM, as `slam.method` has them.
        sources: of odometry, as `estimation.source` has them.
        variants: to be run beside the configuration as it is, with the methods that they concern.
        common: overrides of every run.
        odometry_seeds: recordings of other odometry noises are left out; None takes all.

    Raises:
        RecordingError: one cannot be read.
        ConfigurationError: a method, source or override that the configuration refuses.
        ResultsError: two recordings of the same file name: their saved runs would overwrite each other.
    """
    recordings = list(recordings)
    twice = [stem for stem, n in Counter(path.stem for path in recordings).items() if n > 1]
    if twice:
        raise ResultsError(f"two recordings are named {twice[0]}: expected a name of its own for each")
    tasks: list[RunTask] = []
    seen: set[RunKey] = set()
    for path in recordings:
        metadata = Recording(path).metadata
        name = DriveName.of(path.stem, metadata)
        if odometry_seeds is not None and name.odometry_seed not in odometry_seeds:
            continue
        for source in sources:
            seed = name.odometry_seed if source == "odometry" else None
            for method in methods:
                for variant in (Variant(), *variants):
                    key = RunKey(name.drive, seed, method, source, variant.label)
                    known = bool(metadata) and source == "fused"
                    if not variant.concerns(method) or (known and key in seen):
                        continue
                    if key in seen:
                        key = RunKey(path.stem, seed, method, source, variant.label)
                    seen.add(key)
                    task = RunTask(path, key, (*common, *variant.overrides))
                    task.configured(Configuration())
                    tasks.append(task)
    return tasks


def code_digest() -> str:
    """Of the program's own source: saved runs of another program are not taken for this one's."""
    root = Path(robominer_slam.__file__).parents[1]
    digest = hashlib.sha256()
    for package in CODE:
        for path in sorted((root / package).rglob("*.py")):
            if not PRESENTATION & set(path.relative_to(root).parts):
                digest.update(path.read_bytes())
    return digest.hexdigest()


def run_tasks(
    tasks: Sequence[RunTask],
    folder: Path,
    jobs: int = 1,
    surface_of: SurfaceOf | None = None,
    on_done: Callable[[RunTask], None] = lambda _: None,
) -> Campaign:
    """Evaluate what is not there yet; each run is saved in `folder` as soon as it is done.

    Args:
        tasks: from `plan`.
        folder: results; runs that lie there are taken if recording, configuration and program are the same.
        jobs: processes side by side.
        surface_of: the true surface of a recording; must be importable by other processes if jobs > 1.
        on_done: called after each run, for progress.
    """
    code = code_digest()
    found: dict[int, tuple[RunRecord, bool] | Failure] = {}
    if jobs == 1:
        for k, task in enumerate(tasks):
            found[k] = _one(task, folder, code, surface_of)
            on_done(task)
    else:
        # A fresh interpreter: threads of a progress bar do not survive a fork. Ctrl-C is this process's: runs that have
        # begun are finished and saved, the others are not begun.
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(jobs, context, signal.signal, (signal.SIGINT, signal.SIG_IGN)) as pool:
            waiting: dict[Future[tuple[RunRecord, bool] | Failure], int] = {
                pool.submit(_one, task, folder, code, surface_of): k for k, task in enumerate(tasks)
            }
            try:
                while waiting:
                    done, _ = wait(waiting, return_when=FIRST_COMPLETED)
                    for future in done:
                        k = waiting.pop(future)
                        found[k] = future.result()
                        on_done(tasks[k])
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise
    records, files, failures, reused = [], [], [], 0
    for k, task in enumerate(tasks):
        outcome = found[k]
        if isinstance(outcome, Failure):
            failures.append(outcome)
            continue
        records.append(outcome[0])
        files.append(folder / RUNS / task.file_name)
        reused += outcome[1]
    return Campaign(records, files, failures, reused)


def _one(task: RunTask, folder: Path, code: str, surface_of: SurfaceOf | None) -> tuple[RunRecord, bool] | Failure:
    """The record of a run, and whether it was there from before."""
    path = folder / RUNS / task.file_name
    try:
        fingerprint = task.fingerprint(code, surface_of)
        record = saved_record(path, fingerprint)
        if record is not None:
            return record, True
        result = evaluate_run(task, surface_of)
    except Exception as error:
        if not isinstance(error, OF_THE_RECORDING):
            log.exception("run %s failed", task.file_name)
        return Failure(task, f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else 'no message'}")
    result.save(path, fingerprint)
    return result.record, False
