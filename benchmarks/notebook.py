"""The obvious notebook that a replay is held against: message by message, then pandas and shapely.

It does less than a replay (no causal filter, no path over a network, no location determination system,
no hazards), and gives the user only rates, averages, crossings and a threshold.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

ALPHAS = (0.1, 0.01, 0.001)
THRESHOLD_MPS = 1.0


def notebook(log: Path, site: Path, out: Path) -> Path:
    """Read the log, place the fixes on the track, monitor, find the balises, write Parquet."""
    import pandas as pd

    fixes, odometer = _decode(log)
    fixes = pd.merge_asof(fixes, odometer, on="t", direction="backward")
    fixes["path_m"] = _place(fixes, site)
    seconds = fixes["t"].diff() / 1e9
    fixes["odometer_m"] = (fixes["speed_mps"] * seconds).fillna(0).cumsum()
    rate = (fixes["path_m"].diff() - fixes["odometer_m"].diff()) / seconds
    fixes["along_raw"] = rate
    for alpha in ALPHAS:
        fixes[f"along_ewma_{alpha}"] = rate.ewm(alpha=alpha, adjust=False).mean()
    columns = [name for name in fixes.columns if name.startswith("along_")]
    fixes["alarm"] = (fixes[columns].abs() > THRESHOLD_MPS).any(axis=1)
    out.mkdir(parents=True, exist_ok=True)
    fixes.to_parquet(out / "epochs.parquet", compression="zstd")
    _crossings(fixes, site).to_parquet(out / "passages.parquet", compression="zstd")
    return out


def _decode(log: Path) -> tuple[Any, Any]:
    import pandas as pd
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    fixes, odometer = [], []
    with log.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages():
            stamp = message.header.stamp
            t = stamp.sec * 1_000_000_000 + stamp.nanosec
            if channel.topic == "/gnss":
                fixes.append((t, message.latitude, message.longitude, message.altitude))
            elif channel.topic == "/odometer":
                odometer.append((t, message.twist.twist.linear.x))
    return (
        pd.DataFrame(fixes, columns=["t", "latitude", "longitude", "altitude"]),
        pd.DataFrame(odometer, columns=["t", "speed_mps"]),
    )


def _place(fixes: Any, site: Path) -> Any:
    """Distance along the track of the nearest segment."""
    from pyproj import Transformer
    from shapely import LineString, Point, STRtree

    track = pl.read_parquet(site / "track.parquet")
    turn = Transformer.from_crs(4326, 32633, always_xy=True)
    x, y = turn.transform(track["longitude_deg"].to_numpy(), track["latitude_deg"].to_numpy())
    segments = [LineString([(x[i], y[i]), (x[i + 1], y[i + 1])]) for i in range(len(x) - 1)]
    begins = np.concatenate([[0.0], np.cumsum([segment.length for segment in segments])])
    tree = STRtree(segments)
    places = []
    for _, fix in fixes.iterrows():
        point = Point(*turn.transform(fix["longitude"], fix["latitude"]))
        nearest = int(tree.nearest(point))
        places.append(begins[nearest] + segments[nearest].project(point))
    return np.asarray(places)


def _crossings(fixes: Any, site: Path) -> Any:
    import pandas as pd

    track = pl.read_parquet(site / "track.parquet")
    lengths = track.group_by("netelement_id", maintain_order=True).agg(pl.col("measure_m").max())
    begins = dict(zip(lengths["netelement_id"], lengths["measure_m"].cum_sum().shift(1, fill_value=0.0), strict=True))
    rows = []
    for balise in pl.read_parquet(site / "balises.parquet").iter_rows(named=True):
        at = begins[balise["netelement_id"]] + balise["measure_m"]
        passed = fixes[fixes["path_m"] >= at]
        if len(passed):
            rows.append((balise["balise_id"], passed.iloc[0]["t"]))
    return pd.DataFrame(rows, columns=["balise_id", "t"])
