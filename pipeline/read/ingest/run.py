"""Reading one recorded run, whatever it is stored as."""

from __future__ import annotations

from collections.abc import Sequence

from pipeline.read.ingest.conform import refuse_too_many
from pipeline.read.ingest.correct import correct_run
from pipeline.read.ingest.mcap_run import MOST_TOPICS, BlockSink, read_mcap, read_mcaps
from pipeline.read.ingest.parquet import read_folder
from pipeline.storage import files
from pipeline.storage.address import Address, name_of, shown
from schemas.config import IngestConfig
from schemas.errors import InputError
from schemas.run import STREAMS, RunLog

_DEFAULTS = IngestConfig()


def read_run(path: Address, config: IngestConfig = _DEFAULTS, with_digest: bool = True) -> RunLog:
    """Read one run from `RUN.mcap` or a folder `RUN/` of Parquet files.

    Every stream has exactly the contract's columns and types; rows stay in recorded order, duplicates included. What
    the configuration corrects in the streams is corrected (`[[ingest.correct]]`).

    Args:
        path: address of `RUN.mcap` or of a folder `RUN/`; local or `s3://`-style.
        config: the section `ingest` of the configuration: mapping of topics and corrections.
        with_digest: compute the SHA-256 of its files, which results are stamped with; else `input_digest` is empty.

    Returns:
        The run: one frame per stream, in the units of the contract.

    Raises:
        InputError: the log breaches the contract; all breaches in one. A log that is cut off is read up to the damage
            and says so in `notes`.

    Source:
        CONTRACT section 1.
    """
    return correct_run(_require_limits(_read_recorded(path, config, with_digest), path, config), config.correct)


def read_part(
    paths: Sequence[Address], config: IngestConfig, partly: bool = False, observers: Sequence[BlockSink] = ()
) -> RunLog:
    """The run in MCAP files of one log, which may be one of several of a run (`read_mcaps`), read as by `read_run`."""
    run = read_mcaps(paths, config, partly=partly, observers=observers)
    return correct_run(_require_limits(run, paths[0], config), config.correct, later=partly)


def _require_limits(run: RunLog, path: Address, config: IngestConfig) -> RunLog:
    """The same run; raises `InputError` where it has more rows or solutions than any journey."""
    for stream in STREAMS:
        if (frame := run.stream(stream)) is not None:
            refuse_too_many(frame.height, f"{shown(path)}: {stream}", config)
    if (count := run.gnss["solution"].n_unique()) > MOST_TOPICS:
        raise InputError(
            "holds more solutions of the position than any train has receivers",
            place=f"{shown(path)}: gnss, column solution",
            found=str(count),
            expected=f"at most {MOST_TOPICS}",
        )
    return run


def _read_recorded(path: Address, config: IngestConfig, with_digest: bool) -> RunLog:
    """The run as it is stored, whatever the form."""
    if name_of(path).endswith(".mcap"):
        return read_mcap(path, config, with_digest)
    if files.is_dir(path):
        return read_folder(path, config, with_digest)
    if not files.exists(path):
        raise InputError("does not exist", place=shown(path), expected="RUN.mcap or a folder RUN/")
    raise InputError(
        "is neither an MCAP file nor a folder",
        place=shown(path),
        expected="RUN.mcap or a folder RUN/ of Parquet files",
        remedy="`balise convert` makes runs of receiver logs.",
    )
