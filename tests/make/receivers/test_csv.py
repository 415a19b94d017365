"""CSV logs as other programs write them, through a mapping."""

from __future__ import annotations

import tomllib
from datetime import UTC, datetime, timedelta

import pytest

from pipeline.make.receivers import convert, gather
from pipeline.read.ingest.csv_draft import draft_mapping
from schemas.config import Configuration, settings_from
from schemas.errors import BaliseError, ConfigError, InputError

PLACE = {"latitude_deg": "lat", "longitude_deg": "lon"}


@pytest.fixture
def converted(tmp_path):
    def of(text: str | bytes, stream: str = "gnss", **mapping: object):
        path = tmp_path / "log.csv"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        table = {"topic": "log.csv", "time": "field:t", "fields": PLACE} | mapping
        config = settings_from({"ingest": {stream: table}}, Configuration, "x")
        return convert([path], "r", config.ingest).run.gnss

    return of


@pytest.mark.parametrize(
    ("time", "expected"),
    [
        ("2025-06-01T12:00:00.25", "12:00:00.250"), ("2025-06-01 12:00:00", "12:00:00"),
        ("2025-06-01T12:00:00.25Z", "12:00:00.250"), ("2025-06-01T14:00:00+02:00", "12:00:00"),
        ("1748779200", "12:00:00"), ("1748779200250000000", "12:00:00.250"),
    ],
)  # fmt: skip
def test_times_of_a_csv(converted, time, expected):
    t = converted(f"t,lat,lon\n{time},50.5,4.5\n")["t"]
    assert t.dt.to_string("%Y-%m-%dT%H:%M:%S%.f").to_list() == [f"2025-06-01T{expected}"]


def test_units_and_scales_of_time_are_those_of_the_mapping(converted):
    with pytest.raises(InputError, match=r"time unit unknown; looks like milliseconds.*1748779200250"):
        converted("t,lat,lon\n1748779200250,50.5,4.5\n")
    milliseconds = converted("t,lat,lon\n1748779200250,50.5,4.5\n", factors={"t": 1e-3})
    assert milliseconds["t"].dt.to_string("%T%.f").to_list() == ["12:00:00.250"]
    # 1,432,814,418 s after 1980-01-06 on the GPS scale, which is 18 s ahead of UTC.
    gps = converted("t,lat,lon\n1432814418,50.5,4.5\n", time_scale="gps", time_epoch="gps")
    assert gps["t"].dt.to_string("%FT%T").to_list() == ["2025-06-01T12:00:00"]


@pytest.mark.parametrize(
    "text",
    [
        b"\xef\xbb\xbft;lat;lon\r\n1748779200;50.5;4.5\r\n",
        "t\tlat\tlon\n1748779200\t50.5\t4.5\n".encode("utf-16"),
        b"# made by a logger\nt, lat , lon\n1748779200, 50.5, 4.5\n\n,,\n\n",
        b'"lon","extra","lat","t"\n"4.5","a, b","50.5","1748779200"\n',
    ],
)
def test_separators_byte_order_marks_blanks_and_empty_lines(converted, text):
    row = converted(text).row(0, named=True)
    assert (row["latitude_deg"], row["longitude_deg"], row["fix"]) == (50.5, 4.5, "autonomous")


def test_nan_and_empty_cells_are_unknown(converted):
    fixes = converted("t,lat,lon\n1748779200,nan,NaN\n1748779201,,\n1748779202,50.5,4.5\n")
    assert fixes["latitude_deg"].to_list() == [None, None, 50.5]


def test_kinds_of_fix_by_text_number_and_word(converted):
    fields = PLACE | {"fix": "q"}
    codes = {"NARROW_INT3": "rtk_fixed", "SINGLE": "autonomous"}
    texts = converted("t,lat,lon,q\n1,50,4,NARROW_INT3\n2,50,4,SINGLE\n", fields=fields, fix_codes=codes)
    assert texts["fix"].to_list() == ["rtk_fixed", "autonomous"]
    numbers = converted("t,lat,lon,q\n1,50,4,4\n", fields=fields, fix_codes={"4": "rtk_fixed"})
    assert numbers["fix"].to_list() == ["rtk_fixed"]
    words = converted("t,lat,lon,q\n1,50,4,sbas\n", fields=fields)
    assert words["fix"].to_list() == ["sbas"]
    with pytest.raises(InputError, match=r"column fix.*'code 7'"):
        converted("t,lat,lon,q\n1,50,4,7\n", fields=fields, fix_codes={"4": "rtk_fixed"})


@pytest.mark.parametrize(
    ("text", "mapping", "message"),
    [
        ("t,lat,lon\n1,50,4\n", {"fields": PLACE | {"heigth_m": "lat"}}, "this stream does not have.*heigth_m"),
        ("t,lat,lon\n1,50,4\n", {"fields": PLACE | {"height_m": "h"}}, "no field h for column height_m"),
        ("tt,lat,lon\n1,50,4\n", {}, "no field t for column t"),
        ("t,lat,lon\n,50,4\n2,50,4\n", {}, "column t: has missing values"),
        ("t,lat,lon\nabc,50,4\n", {}, "column t: holds no times"),
        ("t,lat,lon\n1,50,400\n", {}, "longitude_deg: is out of range; found 400"),
        ("t;lat;lon\n1;50,5;4.5\n", {}, "column lat: cannot be latitude_deg"),
        ("t,lat,lon,lat\n1,50,4,51\n", {}, "two columns have the same name: lat"),
        ("t,lat,lon, lat \n1,50,4,51\n", {}, "two columns have the same name: lat"),
        ("t,lat,lon\ntrue,50,4\n", {}, "field t: is not a time; found flag"),
        ("t,lat,lon\n20000000000,50,4\n", {}, "time unit unknown; found 20000000000"),
        ("", {}, "is not a CSV file"),
        ("t,lat,lon\n", {}, "no epoch with a time and a position"),
        ("t,lat,lon\n1,50,4\n", {"time": "auto"}, "has no log time"),
        ("t,lat,lon\n1,50,4\n", {"constants": {"fix": "bogus"}}, "constants.fix.*found 'bogus'"),
        ("t,lat,lon\n1,50,4\n", {"constants": {"satellites": 9.5}}, "constants.satellites.*found 9.5"),
    ],
)
def test_what_does_not_fit_is_one_clear_error(converted, text, mapping, message):
    with pytest.raises(BaliseError, match=message) as caught:
        converted(text, **mapping)
    assert isinstance(caught.value, InputError | ConfigError)


def test_a_name_of_two_lines_is_a_name(converted):
    assert converted('\n"t","lat\n(deg)",lon\n1,50,4\n', fields=PLACE | {"latitude_deg": "lat\n(deg)"}).height == 1


def test_columns_without_a_name_are_passed_over(converted):
    assert converted("t,lat,lon,,\n1,50,4,,\n2,50,4,,x\n").height == 2


def test_a_log_without_rows_or_times_beside_another_is_told(tmp_path):
    config = settings_from({"ingest": {"gnss": {"topic": "*", "time": "field:t", "fields": PLACE}}}, Configuration, "x")
    full, other = tmp_path / "a.csv", tmp_path / "b.csv"
    full.write_text("t,lat,lon\n1748779200,50,4\n1748779201,50,4\n")
    other.write_text("t,lat,lon\n")
    assert convert([other, full], "r", config.ingest).run.gnss.height == 2
    other.write_text("t,lat,lon\n,50,4\n,50,4\n")
    with pytest.raises(InputError, match=r"b\.csv: column t: has missing values"):
        convert([full, other], "r", config.ingest)


GERMAN = "Datum;Uhrzeit;Breite;Länge\n{};12:00:00,5;50,5;4,5\n{};12:00:01,5;50;4\n"
COLUMNS = {"time": "field:Datum + Uhrzeit", "fields": {"latitude_deg": "Breite", "longitude_deg": "Länge"}}


@pytest.mark.parametrize("encoding", ["utf-8", "latin-1", "utf-16", "utf-16-le"])
def test_spreadsheets_in_their_encodings_with_decimal_commas_and_two_columns(converted, encoding):
    fixes = converted(GERMAN.format("13.06.2025", "13.06.2025").encode(encoding), **COLUMNS)
    assert fixes["latitude_deg"].to_list() == [50.5, 50.0]
    assert fixes["t"].dt.to_string("%FT%T%.3f").to_list() == ["2025-06-13T12:00:00.500", "2025-06-13T12:00:01.500"]


def test_day_and_month_are_decided_over_the_whole_file_or_asked_for(converted):
    decided = converted(GERMAN.format("01.06.2025", "13.06.2025"), **COLUMNS)
    assert decided["t"].dt.date().cast(str).to_list() == ["2025-06-01", "2025-06-13"]
    with pytest.raises(InputError, match=r"fit day first and month first.*date_order"):
        converted(GERMAN.format("01.06.2025", "02.06.2025"), **COLUMNS)
    asked = converted(GERMAN.format("01.06.2025", "02.06.2025"), **COLUMNS, date_order="month_first")
    assert asked["t"].dt.date().cast(str).to_list() == ["2025-01-06", "2025-02-06"]
    with pytest.raises(InputError, match="dates of two kinds"):
        converted(GERMAN.format("13.06.2025", "06.13.2025"), **COLUMNS)
    with pytest.raises(InputError, match="another kind than date_order; found day_first"):
        converted(GERMAN.format("13.06.2025", "13.06.2025"), **COLUMNS, date_order="month_first")


def test_weeks_excel_days_halves_of_the_day_and_a_row_of_units(converted):
    def times(text, **mapping):
        return converted(text, **mapping)["t"].dt.to_string("%FT%T%.3f").to_list()

    # 2025-06-01 is a Sunday, on which week 2369 begins; UTC is 18 s behind.
    weeks = "w,s,lat,lon\n-,s,deg,deg\n2369,43218.5,50.5,4.5\n"
    assert times(weeks, time="field:w + s", time_epoch="gps") == ["2025-06-01T12:00:00.500"]
    with pytest.raises(InputError, match="found 321 in row 1; expected 1024"):
        times(weeks.replace("2369", "321"), time="field:w + s", time_epoch="gps")
    # As a spreadsheet shows 2025-06-01 06:00 as a number.
    assert times("t,lat,lon\n45809.25,50,4\n", time_epoch="excel") == ["2025-06-01T06:00:00.000"]
    assert times("t,lat,lon\n45809,50,4\n", time_epoch="excel") == ["2025-06-01T00:00:00.000"]
    halves = times("t,lat,lon\n6/13/2025 1:00:00 PM,50,4\n6/13/2025 12:30 AM,50,4\n")
    assert halves == ["2025-06-13T13:00:00.000", "2025-06-13T00:30:00.000"]


@pytest.mark.parametrize(
    ("text", "latitudes"),
    [
        ("sep=;\nt;lat;lon\n1;1.234,5;4\n2;234,25;4\n", [1234.5, 234.25]),
        ('t,lat,lon\n1,"1,234.5",4\n2,−7.5,4\n', [1234.5, -7.5]),
        ("t;lat;lon\n1;1 234,5;4\n2;−7;4\n", [1234.5, -7.0]),
        ('t,lat,lon\n1,"1,234",4\n2,"1,5",4\n', [1.234, 1.5]),
    ],
)
def test_thousands_and_decimal_marks(converted, text, latitudes):
    fixes = converted(text, factors={"latitude_deg": 1e-2})
    assert fixes["latitude_deg"].to_list() == pytest.approx([value / 100 for value in latitudes])


def test_thousands_are_no_fractions(converted):
    with pytest.raises(InputError, match=r"column lat: cannot be latitude_deg; found 1,234 in row 1"):
        converted('t,lat,lon\n1,"1,234",4\n')


def test_rows_that_do_not_fit_the_header(tmp_path):
    log = tmp_path / "odo.csv"
    table = {"topic": "*", "time": "field:t", "fields": {"distance_m": "d", "speed_mps": "v"}}
    config = settings_from({"ingest": {"odometer": table}}, Configuration, "x").ingest
    log.write_text("t,d,v\n1,10,1\n2,11\n3,nan,n/a\n4,NaN,\n".replace("n/a", ""))
    found = gather([log], config)
    assert found.streams["odometer"].select("distance_m", "speed_mps").rows() == [(10.0, 1.0), (11.0, None)]
    assert found.dropped == {
        "end of a row, which is missing (taken as empty)": 1, "row without a value of odometer": 2,
    }  # fmt: skip
    log.write_text("Logger 7\nt,d,v\n1,10,1\n2,11,1\n")
    found = gather([log], config)
    assert (found.streams["odometer"].height, found.dropped) == (2, {"line above the header": 1})
    log.write_text("t,d\n1,10,1\n")
    with pytest.raises(
        InputError, match=r"line 2, .*more values than the header; found 3: 1, 10, 1; expected at most 2"
    ):
        gather([log], config)


def test_a_table_of_several_recorders_leaves_cells_empty(tmp_path):
    log = tmp_path / "all.csv"
    tables = {
        "gnss": {"topic": "*", "time": "field:t", "fields": PLACE},
        "odometer": {"topic": "*", "time": "field:t", "fields": {"distance_m": "d"}},
        "balise_reads": {"topic": "*", "time": "field:t", "fields": {"balise_id": "b"}},
    }
    config = settings_from({"ingest": tables}, Configuration, "x").ingest
    rows = [(s / 4, "50,4" if s % 4 == 0 and not 20 < s < 32 else ",", "X1" if s == 5 else "") for s in range(49)]
    log.write_text("t,lat,lon,d,b\n" + "".join(f"{t},{place},{t * 10},{read}\n" for t, place, read in rows))
    found = gather([log], config)
    fixes = found.streams["gnss"]
    # A second from 5 s to 8 s has no position: those rows may be an outage and stay.
    outage = fixes.filter(fixes["latitude_deg"].is_null())["t"].dt.epoch("ms")
    assert (outage.min(), outage.max(), fixes["latitude_deg"].count()) == (5250, 7750, 11)
    assert (found.streams["odometer"].height, found.streams["balise_reads"].height) == (49, 1)
    assert found.dropped["row without a value of gnss"] == 49 - 11 - len(outage)
    log.write_text("t,lat,lon,d,b\n0,50,4,1,\n1,,,2,\n2,50,4,3,\n")
    assert gather([log], config).streams["gnss"].height == 3


def test_a_draft_can_be_saved_and_used(tmp_path):
    log = tmp_path / "fahrt.csv"
    log.write_text("Datum;Zeit;Geschw.;v\n;;;km/h\n13.06.2025;12:00:00;x;36,0\n13.06.2025;12:00:01;y;37,8\n")
    config = settings_from(tomllib.loads(draft_mapping(log)), Configuration, "x").ingest
    assert gather([log], config).streams["odometer"]["speed_mps"].to_list() == pytest.approx([10.0, 10.5])
    log.write_text("Datum;Zeit;v\n;;m/s\n01.06.2025;12:00:00;36,0\n01.06.2025;12:00:01;37,8\n")
    assert "# date_order" in draft_mapping(log)
    log.write_text("Zeit;Weg\n13.06.2025 12:00:00;12x4\n")
    assert "# distance_m: left out, since 'Weg' holds no number in 1 rows, first '12x4'" in draft_mapping(log)
    log.write_text("a,b\n1,2\n")
    assert "No name tells" in draft_mapping(log)


def test_a_draft_keeps_the_odometers_of_a_train_apart(tmp_path):
    log = tmp_path / "odo.csv"
    day = "2025-06-13T12:00:0"
    rows = [f"{day}{second}Z,{sensor},{way}" for second in range(3) for sensor, way in (("tacho", 1), ("radar", 2))]
    log.write_text("\n".join(["time,sensor,dist_m", *rows]) + "\n")
    config = settings_from(tomllib.loads(draft_mapping(log)), Configuration, "x").ingest
    assert gather([log], config).streams["odometer"]["sensor"].to_list() == ["tacho", "radar"] * 3


def test_a_draft_of_balise_reads(tmp_path):
    log = tmp_path / "reads.csv"
    log.write_text("time,balise\n2025-06-13T12:00:00Z,PB1\n2025-06-13T12:01:00Z,PB2\n")
    config = settings_from(tomllib.loads(draft_mapping(log)), Configuration, "x").ingest
    assert gather([log], config).streams["balise_reads"]["balise_id"].to_list() == ["PB1", "PB2"]


BERLIN = {"time_zone": "Europe/Berlin"}


@pytest.mark.parametrize(
    ("time", "expected"),
    [
        ("2025-06-01 14:00:00.25", "2025-06-01T12:00:00.250"),  # CEST, UTC+2
        ("15.01.2025 13:00:00", "2025-01-15T12:00:00"),  # CET, UTC+1
        ("2025-06-01T14:00:00+03:00", "2025-06-01T11:00:00"),  # what is written counts
        ("2025-10-26 02:30:00+02:00", "2025-10-26T00:30:00"),
        ("2025-10-26 03:00:00", "2025-10-26T02:00:00"),
    ],
)
def test_local_times_by_their_zone(converted, time, expected):
    t = converted(f"t,lat,lon\n{time},50.5,4.5\n", **BERLIN)["t"]
    assert t.dt.to_string("%Y-%m-%dT%H:%M:%S%.f").to_list() == [expected]


@pytest.mark.parametrize(
    ("time", "says"),
    [
        (
            "2025-10-26 02:30:00",
            r"not clear in Europe/Berlin; found .* 02:30:00 in row 1; expected each time once.*"
            r'time_zone = "Etc/GMT-2" or "Etc/GMT-1"',
        ),
        (
            "2025-03-30 02:30:00",
            r'clocks never show in Europe/Berlin; found .* 02:30:00 in row 1.*time_zone = "Etc/GMT-1"',
        ),
    ],
)
def test_hours_that_clocks_show_twice_or_never_are_refused(converted, time, says):
    with pytest.raises(InputError, match=says):
        converted(f"t,lat,lon\n{time},50.5,4.5\n", **BERLIN)


def clock_rows(*spans):
    """Rows every 30 s over spans of a clock in the night of 2025-10-26."""
    minutes = [begin + half / 2 for begin, end in spans for half in range(int(2 * (end - begin)))]
    return [f"2025-10-26 {int(m // 60):02d}:{int(m % 60):02d}:{int(m * 60 % 60):02d}" for m in minutes]


def utc_minutes(converted, rows):
    frame = converted("t,lat,lon\n" + "".join(f"{row},50.5,4.5\n" for row in rows), **BERLIN)
    midnight = datetime(2025, 10, 26, tzinfo=UTC)
    return [(t - midnight).total_seconds() / 60 for t in frame["t"]]


@pytest.mark.parametrize(
    ("spans", "begin"),
    [
        # By hand: 01:50 CEST is 23:50 UTC the day before, 03:00 CET is 02:00 UTC; clocks go back at 01:00 UTC.
        (((110, 180), (120, 190)), -10),
        (((110, 150),), -10),  # ends in the first hour
        (((150, 190),), 90),  # begins in the second hour
    ],
)
def test_an_hour_that_clocks_show_twice_by_the_order_of_its_rows(converted, spans, begin):
    found = utc_minutes(converted, clock_rows(*spans))
    assert found == [begin + half / 2 for half in range(len(found))]


@pytest.mark.parametrize(
    "spans",
    [
        ((130, 170),),  # within the hour alone
        ((110, 190),),  # over both ends without a step: a clock that was not changed, or a pause
        ((110, 150), (155, 190)),  # a pause in which the clock may have been set
        ((110, 180), (120, 150), (155, 190)),
    ],
)
def test_rows_that_leave_such_an_hour_open_are_refused(converted, spans):
    with pytest.raises(InputError, match="not clear in Europe/Berlin"):
        utc_minutes(converted, clock_rows(*spans))


def test_a_clock_that_never_changes_has_a_zone_of_its_own(converted):
    rows = "t,lat,lon\n2025-10-26 02:30:00,50.5,4.5\n2025-10-26 03:30:00,50.5,4.5\n"
    t = converted(rows, time_zone="Etc/GMT-1")["t"]
    assert t.dt.to_string("%FT%T").to_list() == ["2025-10-26T01:30:00", "2025-10-26T02:30:00"]


def test_letters_of_a_zone_in_the_cells(converted):
    assert converted("t,lat,lon\n2025-06-01 14:00:00 UTC,50.5,4.5\n")["t"].dt.hour().to_list() == [14]
    with pytest.raises(InputError, match=r'letters do not tell for certain.*time_zone = "Europe/Berlin"'):
        converted("t,lat,lon\n2025-06-01 14:00:00 CEST,50.5,4.5\n")
    assert converted("t,lat,lon\n2025-06-01 14:00:00 CEST,50.5,4.5\n", **BERLIN)["t"].dt.hour().to_list() == [12]
    assert converted("t,lat,lon\n2025-01-01 14:00:00 MEZ,50.5,4.5\n", **BERLIN)["t"].dt.hour().to_list() == [13]
    with pytest.raises(InputError, match="letters are not those of Europe/Berlin"):
        converted("t,lat,lon\n2025-06-01 14:00:00 CET,50.5,4.5\n", **BERLIN)


def test_zones_of_times_that_have_none(converted):
    with pytest.raises(InputError, match="holds numbers, which count the same everywhere"):
        converted("t,lat,lon\n1748779200,50.5,4.5\n", **BERLIN)
    with pytest.raises(ConfigError, match="is no time zone; found Europe/Berlino"):
        converted("t,lat,lon\n2025-06-01 14:00:00,50.5,4.5\n", time_zone="Europe/Berlino")
    # 45,809.5 days after 1899-12-30: 2025-06-01, noon.
    t = converted("t,lat,lon\n45809.5,50.5,4.5\n", **BERLIN, time_epoch="excel")["t"]
    assert t.dt.to_string("%FT%T").to_list() == ["2025-06-01T10:00:00"]


def test_reads_beside_other_columns_are_offered(tmp_path):
    log = tmp_path / "plc.csv"
    log.write_text("time,speed [km/h],balise_id\n2025-06-01T12:00:00Z,36,\n2025-06-01T12:00:01Z,36,B7\n")
    config = settings_from(tomllib.loads(draft_mapping(log)), Configuration, "x")
    streams = gather([log], config.ingest).streams
    assert streams["odometer"].height == 2
    assert streams["balise_reads"]["balise_id"].to_list() == ["B7"]


def test_ranges_without_positions_name_the_next_step(tmp_path):
    log = tmp_path / "rover.obs"
    log.write_text("     3.04           OBSERVATION DATA    M                   RINEX VERSION / TYPE\n")
    with pytest.raises(InputError, match=r"holds no message.*RINEX holds ranges, no positions.*rnx2rtkp.*\.pos"):
        gather([log])


def test_a_draft_declares_no_odometer_beside_positions(tmp_path):
    log = tmp_path / "log.csv"
    log.write_text("time,lat,lon,speed,bearing,fix,cov_ee_m2\n2025-06-01T10:00:00Z,50.1,4.1,3.5,90,sbas,0.25\n")
    draft = draft_mapping(log)
    drafted = tomllib.loads(draft)["ingest"]
    assert list(drafted) == ["gnss"]
    assert '# fields = { speed_mps = "speed" }' in draft
    assert "# Unused columns: speed, bearing\n" in draft
    (gnss,) = drafted["gnss"]
    gnss = gnss["fields"]
    assert (gnss["fix"], gnss["cov_ee_m2"]) == ("fix", "cov_ee_m2")


def test_a_draft_leaves_the_origin_of_an_odometer_to_its_owner(tmp_path):
    log = tmp_path / "odo.csv"
    log.write_text("time,speed (m/s)\n2025-06-01T10:00:00Z,3.5\n")
    draft = draft_mapping(log)
    (mapping,) = tomllib.loads(draft)["ingest"]["odometer"]
    assert "origin" not in mapping
    assert '# origin = "wheel"' in draft


def test_times_of_a_draft_are_never_taken_for_utc_against_their_name(tmp_path):
    local, gps = tmp_path / "local.csv", tmp_path / "gps.csv"
    local.write_text("Zeit (MESZ);Breite;Länge\n2025-06-01 10:00:00;50.1;4.1\n")
    assert "time" not in tomllib.loads(draft_mapping(local))["ingest"]["gnss"][0]
    gps.write_text("millisSinceGpsEpoch,LatitudeDegrees,LongitudeDegrees\n1300000000000,50.1,4.1\n")
    mapping = settings_from(tomllib.loads(draft_mapping(gps)), Configuration, "draft").ingest
    # 1.3e9 s after 1980-01-06 on a scale that is 18 s ahead of UTC.
    expected = datetime(1980, 1, 6, tzinfo=UTC) + timedelta(seconds=1.3e9 - 18)
    assert gather([gps], mapping).streams["gnss"]["t"].to_list() == [expected]
