"""RTKLIB's `.pos` in all its forms, each value worked by hand."""

from __future__ import annotations

import pytest

from pipeline.make.receivers import convert
from schemas.errors import InputError

HEAD = "% program   : RTKLIB ver.2.4.3 b34\n% ref pos   :  50.000000000   4.000000000   100.0000\n%\n"
LLH = "(lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float,3:sbas,4:dgps,5:single,6:ppp,ns=# of satellites)"
PLANE = "latitude(deg) longitude(deg) height(m) Q ns sdn(m) sde(m) sdu(m) sdne(m)  sdeu(m)  sdun(m) age(s)  ratio"
DEGREES = PLANE.replace("(deg)", "(d'\")")
BASELINE = "e-baseline(m) n-baseline(m) u-baseline(m) Q ns"
END = "1   8   0.0100   0.0200   0.0300  -0.0050   0.0060   0.0000   1.00   50.0\n"


@pytest.fixture
def row_of(tmp_path):
    def of(*lines: str):
        path = tmp_path / "rover.pos"
        path.write_text(HEAD + "".join(lines))
        return convert([path], "r").run.gnss.row(0, named=True)

    return of


@pytest.mark.parametrize(
    ("scale", "time", "utc"),
    [
        ("GPST", "2021/03/19 13:00:00.250", "12:59:42.250"),  # 18 leap seconds since 2017
        ("UTC", "2021/03/19 13:00:00.250", "13:00:00.250"),
        ("JST", "2021/03/19 13:00:00.250", "04:00:00.250"),
        ("GPST", "2149 478800.250", "12:59:42.250"),  # as `obs start` of RTKLIB has the same moment
    ],
)
def test_times(row_of, scale, time, utc):
    row = row_of(f"% {LLH}\n%  {scale}   {PLANE}\n", f"{time}   50.5   -4.5   120.5   {END}")
    assert row["t"].strftime("%Y-%m-%d %H:%M:%S.%f")[:-3] == f"2021-03-19 {utc}"


@pytest.mark.parametrize("row", ["2149 4_0.0 50.5", "2149 1e13 50.5", "9999/01/01 00:00:00.0 50.5", "2149 40.0 5_0.5"])
def test_what_only_python_reads_as_a_number_or_a_time_is_refused(row_of, row):
    with pytest.raises(InputError, match=r"is no time|holds a value that is no number"):
        row_of(f"% {LLH}\n%  GPST {PLANE}\n", f"{row} -4.5 120.5 {END}")


def test_deviations_are_variances_with_the_sign_of_their_covariance(row_of):
    row = row_of(f"% {LLH}\n%  GPST {PLANE}\n", f"2021/03/19 13:00:00.000 50.5 -4.5 120.5 {END}")
    assert (row["latitude_deg"], row["longitude_deg"], row["height_m"]) == (50.5, -4.5, 120.5)
    assert (row["fix"], row["satellites"]) == ("rtk_fixed", 8)
    found = [row[f"cov_{axes}_m2"] for axes in ("nn", "ee", "uu", "en", "eu", "nu")]
    assert found == pytest.approx([1e-4, 4e-4, 9e-4, -2.5e-5, 3.6e-5, 0.0], abs=1e-12)


def test_earth_fixed_places_velocities_and_covariances_are_turned(row_of):
    """On the equator at 90 degrees east: x points west, y up, z north."""
    columns = "x-ecef(m) y-ecef(m) z-ecef(m) Q ns sdx(m) sdy(m) sdz(m) sdxy(m) sdyz(m) sdzx(m) age(s) ratio"
    columns += " vx(m/s) vy(m/s) vz(m/s)"
    line = "2021/03/19 13:00:00.000;0.0;6378147.0;0.0;2;8;1.0;2.0;3.0;0.5;0.0;-0.7;0.0;2.0;1.0;2.0;3.0\n"
    row = row_of(f"% (x/y/z-ecef=WGS84)\n%  GPST;{columns.replace(' ', ';')}\n", line)
    assert (row["latitude_deg"], row["longitude_deg"], row["height_m"]) == pytest.approx((0, 90, 10), abs=1e-6)
    assert [row[f"vel_{axis}_mps"] for axis in "enu"] == pytest.approx([-1, 3, 2])
    found = [row[f"cov_{axes}_m2"] for axes in ("ee", "nn", "uu", "eu", "en", "nu")]
    assert found == pytest.approx([1, 9, 4, -0.25, 0.49, 0], abs=1e-9)
    assert row["fix"] == "rtk_float"


def test_a_height_over_the_geoid_is_none_over_the_ellipsoid(row_of):
    text = LLH.replace("ellipsoidal", "geodetic")
    row = row_of(f"% {text}\n%  GPST {PLANE}\n", f"2021/03/19 13:00:00.000 50.5 -4.5 120.5 {END}")
    assert row["height_m"] is None


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ([f"2021/03/19 13:00:00.000 50.5 4.5 120.5 {END}"], "no line that names its columns.*out-outhead"),
        ([f"%  GPST {PLANE}\n", f"2021/03/19 13:00:00.000 50.5 120.5 {END}"], "line 5: does not fit the header"),
        ([f"%  GPST {PLANE}\n", f"2021/03/19 25:00:00.000 50.5 4.5 120.5 {END}"], "row 1 of the epochs: is no time"),
        ([f"%  GPST {PLANE}\n", f"2021/03/19 13:00:00.000 50.5 4.5 120.5 9{END[1:]}"], "column Q: holds a quality"),
        (["% (WGS84->Tokyo)\n", f"%  GPST {PLANE}\n", f"2021/03/19 13:00:00.000 50 4 1 {END}"], "Tokyo datum"),
        ([f"%  GPST {PLANE}\n"], "holds no epoch"),
        ([f"%  GPST {DEGREES}\n", f"2021/03/19 13:00:00.000 50 30 36 -0 15 18 9 {END}"], "out-degform = deg"),
        ([f"%  GPST {BASELINE}\n", "2021/03/19 13:00:00.000 1000.0 2000.0 5.0 1 8\n"], "out-solformat = llh"),
    ],
)
def test_what_the_header_does_not_explain_is_refused(row_of, lines, message):
    with pytest.raises(InputError, match=message):
        row_of(*lines)


def test_a_header_that_lacks_a_column(tmp_path):
    path = tmp_path / "a.pos"
    row = f"2020/12/04 20:45:12.000 51.15 -114.03 120.5 {END}"
    path.write_text(f"{HEAD}% {LLH}\n%  GPST {PLANE.replace('height(m)', 'hight(m)')}\n{row}")
    with pytest.raises(InputError, match="has no column height; found latitude, longitude, hight"):
        convert([path], "r")


def test_solutions_of_two_forms_in_one_file(tmp_path):
    path = tmp_path / "a.pos"
    parts = [
        f"{HEAD}% {LLH}\n%  {scale} {PLANE}\n2020/12/04 20:45:12.000 51.15 -114.03 120.5 {END}"
        for scale in ("GPST", "UTC")
    ]
    path.write_text(parts[0] * 2)
    assert convert([path], "r").run.gnss.height == 2
    path.write_text("".join(parts))
    with pytest.raises(InputError, match=r"holds solutions of several forms; found GPST latitude.*, UTC latitude"):
        convert([path], "r")
