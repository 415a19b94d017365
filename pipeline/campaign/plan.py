"""What a campaign is to do: which runs, with what, and what earlier calls have done already."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import field, replace

from pipeline import storage
from pipeline.read.site.read import read_site, refuse_unrelated
from pipeline.results import store
from pipeline.results.manifest import SettingsFiles, file_list_text, settings_files, unaltered_metadata
from pipeline.results.software import software_digest
from pipeline.storage import files
from pipeline.storage.address import Address, join, name_of, redacted, stem_of
from schemas.config import Configuration, SiteConfig, Vehicle, digest_of
from schemas.errors import InputError, SiteError, UsageError
from schemas.frozen import frozen
from schemas.run import STREAMS, Site
from schemas.version import SOFTWARE

# At most one, by digest of its files and configuration: the same content is the same site, wherever it lies.
_kept_sites: dict[tuple[str, SiteConfig], Site] = {}


def keep_site(site: Site, config: SiteConfig) -> None:
    """Keep this site, and no other, in this process, so that no run reads it again."""
    _kept_sites.clear()
    _kept_sites[site.digest, config] = site


def kept_sites() -> list[tuple[Site, SiteConfig]]:
    """The sites of this process, for a new worker to keep."""
    return [(site, config) for (_, config), site in _kept_sites.items()]


def site_at(address: str, digest: str, config: SiteConfig) -> Site:
    """The site of this digest, read where this process does not keep it. Raises `SiteError` where it has changed."""
    if (digest, config) not in _kept_sites:
        storage.reach(address)  # or a worker that the store does not answer would end the campaign, not fail its run
        site = read_site(address, config)
        if site.digest != digest:
            remedy = "Start the campaign again."
            raise SiteError("has changed since the campaign began", place=redacted(address), remedy=remedy)
        keep_site(site, config)
    return _kept_sites[digest, config]


_NULL_OF_HIVE = "__HIVE_DEFAULT_PARTITION__"


@frozen
class RunJob:
    """One run as a worker gets it; everything in it survives the way to another machine.

    `previous` is the metadata of the complete run that an earlier campaign left, if any; `campaign` the name
    under which its campaign holds the output (`lock.check_held`). `route`: the file with this run's own route, and its
    digest; `write_route`: the file to write the route that was found to; `site_files`: the site's files as the manifest
    lists them. Empty where there is none.
    """

    run_id: str
    address: str
    site: str
    site_digest: str
    config: Configuration
    vehicle: Vehicle
    out: str
    software_digest: str
    config_digest: str = ""
    previous: Mapping[str, str] | None = None
    campaign: str = ""
    route: str = ""
    route_digest: str = ""
    write_route: str = ""
    site_files: str = ""


@frozen
class Plan:
    """All runs of one call, and where their results go; `given`: the settings files of the call.

    `given_by_digest`: those of runs that have other ones, by the digest of their configuration.
    """

    jobs: tuple[RunJob, ...]
    out: str
    config: Configuration
    vehicle: Vehicle
    given: SettingsFiles = field(default_factory=settings_files)
    given_by_digest: Mapping[str, SettingsFiles] = field(default_factory=dict)


def make_plan(
    runs: Sequence[str],
    site: Address,
    out: Address,
    config: Configuration | None = None,
    vehicle: Vehicle | None = None,
    routes: Address | None = None,
    write_routes: Address | None = None,
    given: SettingsFiles | None = None,
) -> Plan:
    """Resolve what the user named, before any work is done.

    Args:
        runs: paths, globs, folders and addresses.
        site: address of the site.
        out: folder of the result.
        config: the configuration; None: the defaults.
        vehicle: what is known of the vehicle; None: nothing.
        routes: a route file for all runs, or a folder with one per run id.
        write_routes: a folder for the routes found.
        given: the settings as the user wrote them, to be kept with the result.

    Returns:
        One job per run.

    Raises:
        UsageError: no run is found, or the arguments contradict each other.
        SiteError: the site breaches the contract.
    """
    config = config or Configuration()
    vehicle = vehicle or Vehicle()
    try:
        addresses = find_runs(runs)
    except InputError as error:
        # Nobody knows which runs there are: no run failed, the command cannot be met.
        raise UsageError(error.message, place=error.place, expected=error.expected, remedy=error.remedy) from None
    ground = read_site(site, config.site)
    refuse_unrelated(ground, site)
    keep_site(ground, config.site)
    base = RunJob(
        run_id="",
        address="",
        site=storage.absolute(site),
        site_digest=ground.digest,
        site_files=file_list_text(ground.files),
        config=config,
        vehicle=vehicle,
        out=storage.absolute(out),
        software_digest=software_digest(),
        config_digest=digest_of(config, vehicle),
    )
    jobs = [replace(base, run_id=run_id, address=address) for run_id, address in addresses.items()]
    jobs = [_with_routes(job, routes, write_routes) for job in jobs]
    if routes is not None and not any(job.route for job in jobs):
        expected = "a route file, or a folder with RUN.csv or RUN.parquet of these runs"
        raise UsageError("has no route for any of the runs", place=redacted(str(routes)), expected=expected)
    return Plan(tuple(jobs), base.out, config, vehicle, given or settings_files())


def _with_routes(job: RunJob, routes: Address | None, write_routes: Address | None) -> RunJob:
    """The job with its own route, where there is one, and where to write the one that is found."""
    if write_routes is not None:
        job = replace(job, write_route=storage.absolute(join(write_routes, f"{job.run_id}.csv")))
    if routes is None:
        return job
    names = [f"{job.run_id}{suffix}" for suffix in (".csv", ".parquet")]
    candidates = [join(routes, name) for name in names] if files.is_dir(routes) else [routes]
    route = next((address for address in candidates if files.exists(address)), None)
    if route is None:
        return job
    digest = hashlib.sha256(files.read_bytes(route)).hexdigest()
    return replace(job, route=storage.absolute(route), route_digest=digest)


def with_previous(plan: Plan, known: Collection[str] = ()) -> Plan:
    """What is left to do of a plan without the known runs: its jobs with what earlier campaigns completed.

    A run whose marker is not the one that its campaign wrote is not complete.
    """
    left = [job for job in plan.jobs if job.run_id not in known]
    complete = unaltered_metadata(plan.out, [job.run_id for job in left])
    return replace(plan, jobs=tuple(replace(job, previous=complete.get(job.run_id)) for job in left))


def run_digests(job: RunJob, files_digest: str) -> dict[str, str]:
    """What decides a run's tables; equal digests mean equal tables, so that the run is skipped."""
    return {
        "config_digest": job.config_digest,
        "files_digest": files_digest,
        "site_digest": f"{job.site_digest} {job.route_digest}".strip(),
        "software": SOFTWARE,
        "software_digest": job.software_digest,
    }


def find_runs(named: Iterable[str]) -> dict[str, str]:
    """Find the runs that the user named.

    Args:
        named: paths, globs, folders of runs and `s3://`-style addresses.

    Returns:
        Absolute addresses by run id, sorted.

    Raises:
        UsageError: a name finds nothing, or two runs have the same id.
    """
    addresses: dict[str, str] = {}
    for name in named:
        for address in _logs_at(name):
            run_id = stem_of(address)
            _check_name(run_id, address)
            first = addresses.setdefault(run_id, storage.absolute(address))
            if first != storage.absolute(address):
                raise UsageError(
                    f"and {redacted(str(address))} have the same run id {run_id!r}",
                    place=redacted(first),
                    remedy="Rename one of them: results are stored by run id.",
                )
    return dict(sorted(addresses.items()))


def _check_name(run_id: str, address: Address) -> None:
    """Refuse what results cannot be filed under, before any work is done."""
    reason = ""
    if run_id == _NULL_OF_HIVE:
        reason = f"{run_id!r} cannot be a run id: readers of Hive partitions read it as null"
    elif (length := len(store.file_name(run_id))) > store.LONGEST_NAME:
        reason = (
            f"its name is too long to file results under: {length} characters where those beyond ASCII count "
            f"three per byte, and {store.LONGEST_NAME} are possible"
        )
    if reason:
        raise UsageError(reason, place=redacted(str(address)), remedy="Rename it: results are stored by run id.")


def _logs_at(name: str) -> list[Address]:
    """Logs at a place; what its name does not show to be no run is taken for one until it is read."""
    matches = storage.require_match(name)
    return [
        run for match in matches for run in ([match] if is_run(match) or not files.is_dir(match) else _runs_in(match))
    ]


def is_run(address: Address) -> bool:
    """An MCAP log, or a folder with streams as the contract names them."""
    if name_of(address).lower().endswith(".mcap"):
        return True
    names = files.list_dir(address) if files.is_dir(address) else []
    return any(f"{stream}.parquet" in names for stream in STREAMS)


def _runs_in(folder: Address) -> list[Address]:
    """Raises `InputError` for a folder inside that cannot be listed: nobody knows what would be left out."""
    inside = [join(folder, name) for name in files.list_dir(folder) if not name.startswith(".")]
    runs = [child for child in inside if is_run(child)]
    if not runs:
        raise UsageError(
            "holds no run", place=redacted(str(folder)), expected="RUN.mcap files or folders with gnss.parquet"
        )
    return runs
