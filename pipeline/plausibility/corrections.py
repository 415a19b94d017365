"""Lines of configuration that mend a stream, ready to be appended to a file."""

from __future__ import annotations

from collections.abc import Mapping


def correction(
    stream: str,
    factors: Mapping[str, float] | None = None,
    shift_s: float = 0.0,
    exchange: tuple[str, str] | None = None,
    shift_m: Mapping[str, float] | None = None,
    solution: str | None = None,
) -> str:
    """One `[[ingest.correct]]` table."""
    lines = ["[[ingest.correct]]", f'stream = "{stream}"']
    if solution is not None:
        lines.append(f'solution = "{solution}"')
    if exchange is not None:
        lines.append(f'exchange = ["{exchange[0]}", "{exchange[1]}"]')
    if factors:
        lines.append(f"factors = {{ {', '.join(f'{name} = {_number(value)}' for name, value in factors.items())} }}")
    if shift_s:
        lines.append(f"shift_s = {_number(shift_s)}")
    lines += [f"shift_{axis}_m = {_number(value)}" for axis, value in (shift_m or {}).items()]
    return "\n".join(lines) + "\n"


def inline(lines: str) -> str:
    """The same lines as they can stand on one line of a message."""
    head, *tables = lines.split("[[ingest.correct]]\n")
    entries = [f"{{ {', '.join(filter(None, table.splitlines()))} }}" for table in tables]
    plain = "; ".join(filter(None, head.splitlines()))
    corrections = f"[ingest] correct = [{', '.join(entries)}]" if entries else ""
    return "; ".join(part for part in (plain, corrections) if part)


def _number(value: float) -> str:
    """A number as TOML has it, a float always."""
    text = repr(round(value, 12)) if abs(value) >= 1e-3 else repr(value)
    return text if any(sign in text for sign in ".e") else f"{text}.0"
