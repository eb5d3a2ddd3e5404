"""Scenario files and SUMO options."""

from __future__ import annotations

from pathlib import Path

import pytest

from phase_sumo.bridge.sumo.demand import InputFiles, sumo_model
from phase_sumo.bridge.sumo.file_names import OutputFolder, expand, listed, written
from phase_sumo.bridge.sumo.option_names import parse_options
from phase_sumo.bridge.sumo.options import changes, command, read_scenario
from phase_sumo.errors import PhaseError
from tests.helpers.places import NETWORKS

NETWORK = NETWORKS / "f01_straight3.net.xml"
ROUTES = """<routes>
    <vType id="car" vClass="passenger" carFollowModel="Krauss" sigma="0.5"/>
    <vTypeDistribution id="mix">
      <vType id="semi" vClass="trailer" length="20" probability="1"/></vTypeDistribution>
    <vType id="walker" vClass="pedestrian"/>
    <flow id="f" type="car" from="main0" to="main0" begin="0" end="60" period="3"/>
    <flow id="t" type="mix" from="main0" to="main0" begin="0" end="60" period="10"/>
</routes>
"""


@pytest.fixture
def scenario_file(tmp_path):
    """Writes a scenario with further options and returns its path."""

    def write(options="", step=0.1):
        (tmp_path / "demand.rou.xml").write_text(ROUTES)
        path = tmp_path / "test.sumocfg"
        path.write_text(
            f'<configuration><input><net-file value="{NETWORK}"/>'
            '<route-files value="demand.rou.xml"/></input>'
            f'<time><begin value="0"/><end value="30"/><step-length value="{step}"/></time>'
            f"{options}</configuration>"
        )
        return path

    return write


def values(args):
    return dict(zip(args[::2], args[1::2], strict=True))


def test_scenario_is_read(scenario_file):
    scenario = read_scenario(scenario_file())
    assert scenario.net == NETWORK
    assert (scenario.begin, scenario.end, scenario.step_length) == (0.0, 30.0, 0.1)


def test_users_options_win_and_ours_are_there(scenario_file, tmp_path):
    scenario = read_scenario(scenario_file(), ["-e", "00:01:00", "--seed=7", "--fcd-output", "x.xml"])
    assert scenario.end == 60.0
    found = values(command(scenario, tmp_path / "out", seed=3))
    assert found["--seed"] == "7"
    assert "--time-to-teleport" not in found  # SUMO's default holds
    assert found["--collision.action"] == "warn"
    assert found["--fcd-output"] == "x.xml"


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ('<mesosim value="true"/>', "mesosim"),
        ('<lanechange.duration value="3"/>', "lanechange.duration"),
        ('<remote-port value="8813"/>', "remote-port"),
    ],
)
def test_what_cannot_work_is_refused_with_a_remedy(scenario_file, options, named):
    path = scenario_file(options)
    with pytest.raises(PhaseError, match=f"{path.name}.*{named}.*pass -- --{named}"):
        read_scenario(path)
    read_scenario(path, [f"--{named}", "false" if named == "mesosim" else "0"])


def test_what_becomes_of_collisions_is_the_scenarios_and_the_users(scenario_file, tmp_path):
    path = scenario_file('<collision.action value="remove"/><collision.mingap-factor value="1"/>')
    found = values(command(read_scenario(path), tmp_path / "a"))
    assert not {"--collision.action", "--collision.mingap-factor"} & set(found)
    assert not changes(read_scenario(path))
    asked = read_scenario(path, ["--collision.action", "none"])
    assert values(command(asked, tmp_path / "b"))["--collision.action"] == "none"
    assert [str(c) for c in changes(asked)] == ["collision.action remove -> none (the command line says so)"]


@pytest.mark.parametrize(
    ("text", "message"),
    [("<configuration", "not readable as XML"), ("<configuration/>", "holds no SUMO options")],
)
def test_damaged_scenarios(tmp_path, text, message):
    path = tmp_path / "bad.sumocfg"
    path.write_text(text)
    with pytest.raises(PhaseError, match=message):
        read_scenario(path)


def test_missing_files_are_named(scenario_file, tmp_path):
    with pytest.raises(PhaseError, match=r"nothere\.sumocfg"):
        read_scenario(tmp_path / "nothere.sumocfg")
    path = scenario_file()
    (tmp_path / "demand.rou.xml").unlink()
    with pytest.raises(
        PhaseError, match=r"test\.sumocfg: option route-files: .*demand\.rou\.xml does not exist"
    ):
        read_scenario(path)


def test_missing_gui_settings_and_output_folders_are_no_obstacle(scenario_file, tmp_path):
    path = scenario_file(
        '<gui_only><gui-settings-file value="no.view.xml"/></gui_only>'
        '<output><tripinfo-output value="deep/down/trips.xml"/></output>'
    )
    found = values(command(read_scenario(path), tmp_path / "w"))
    assert Path(found["--gui-settings-file"]).is_file()
    assert (tmp_path / "deep" / "down").is_dir()
    redirected = values(command(read_scenario(path), tmp_path / "w", redirect_outputs=True))
    assert Path(redirected["--tripinfo-output"]) == tmp_path / "w" / "trips.xml"


def test_options_are_parsed_like_sumos():
    parsed = parse_options(["-e", "-1", "--no-warnings", "--seed=4", "--scale", "2", "-v"])
    assert parsed == {"end": "-1", "no-warnings": "true", "seed": "4", "scale": "2", "verbose": "true"}
    with pytest.raises(PhaseError, match="stray"):
        parse_options(["stray"])


def test_models_are_replaced_in_every_type_but_pedestrians(scenario_file, tmp_path):
    scenario = read_scenario(scenario_file())
    inputs = InputFiles(tmp_path / "w", model="IDM")
    (route,), (types,) = inputs.rewritten(scenario.route_files), inputs.with_types(())
    text = route.read_text(encoding="utf-8")
    assert text.count('carFollowModel="IDM"') == 2
    assert "Krauss" not in text
    text = types.read_text(encoding="utf-8")
    assert 'DEFAULT_VEHTYPE" vClass="passenger" carFollowModel="IDM"' in text
    assert 'DEFAULT_TAXITYPE" vClass="taxi" carFollowModel="IDM"' in text


def test_models_reach_included_files(tmp_path):
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "types.xml").write_text('<routes><vType id="DEFAULT_VEHTYPE" sigma="0"/></routes>')
    (tmp_path / "deep" / "more.xml").write_text('<routes><include href="types.xml"/></routes>')
    (tmp_path / "r.xml").write_text('<routes><include href="deep/more.xml"/><include href="r.xml"/></routes>')
    inputs = InputFiles(tmp_path / "w", model="IDM")
    (route,), (types,) = inputs.rewritten((tmp_path / "r.xml",)), inputs.with_types(())
    more = Path(route.read_text(encoding="utf-8").split('href="')[1].split('"')[0])
    named = Path(more.read_text(encoding="utf-8").split('href="')[1].split('"')[0])
    assert 'carFollowModel="IDM"' in named.read_text(encoding="utf-8")
    assert "DEFAULT_VEHTYPE" not in types.read_text(encoding="utf-8")  # defined by the included file


def test_models_reach_a_loaded_state(scenario_file, tmp_path):
    state = '<snapshot><vType id="car" vClass="passenger" carFollowModel="Krauss"/></snapshot>'
    (tmp_path / "state.xml").write_text(state)
    scenario = read_scenario(scenario_file('<input><load-state value="state.xml"/></input>'))
    assert "--load-state" not in values(command(scenario, tmp_path / "w"))
    loaded = Path(values(command(scenario, tmp_path / "w", model="IDM"))["--load-state"])
    assert 'carFollowModel="IDM"' in loaded.read_text(encoding="utf-8")


def test_files_without_change_are_used_as_they_are(scenario_file, tmp_path):
    scenario = read_scenario(scenario_file())
    inputs = InputFiles(tmp_path / "w")
    assert inputs.rewritten(scenario.route_files) == scenario.route_files
    assert inputs.with_types(()) == ()


def test_detector_outputs_go_to_our_folder_and_inputs_stay_found(scenario_file, tmp_path):
    scenario_file()
    detectors = tmp_path / "det.add.xml"
    detectors.write_text(
        '<additional><inductionLoop id="d" lane="main0_0" pos="9" period="60" file="loops/d.xml"/>'
        '<inductionLoop id="e" lane="main0_1" pos="9" period="60" file="loops/d.xml"/>'
        '<edgeData id="e" file="NUL"/><edgeData id="f" file="other/d.xml"/>'
        '<vType id="t"><param key="device.ssm.file" value="ssm.xml"/></vType>'
        '<poly id="p" imgFile="pics/p.png" shape="0,0"/></additional>'
    )
    out = tmp_path / "w"
    (rewritten,) = InputFiles(out, outputs=OutputFolder(out)).rewritten((detectors,))
    text = rewritten.read_text(encoding="utf-8")
    assert text.count(f'file="{out}/d.xml"') == 2  # one file for both, as in the scenario
    assert f'file="{out}/other_d.xml"' in text
    assert f'value="{out}/ssm.xml"' in text
    assert 'file="NUL"' in text
    assert f'imgFile="{tmp_path}/pics/p.png"' in text


def test_no_output_takes_the_name_of_another_or_of_ours(tmp_path):
    folder = OutputFolder(tmp_path, prefix="trips", suffix="")
    assert Path(folder.place(".csv", Path("a"))).name == "a_.csv"  # trips.csv is ours
    plain = OutputFolder(tmp_path)
    names = [Path(plain.place(name, Path("base"))).name for name in ("a/x.xml", "b/X.xml", "result.json")]
    assert names == ["x.xml", "b_X.xml", "base_result.json"]
    assert plain.place("localhost:9000", Path("a")) == "localhost:9000"


def test_where_sumo_writes():
    assert written("o/t.xml.gz", "p_", "_x") == Path("o/p_t_x.xml.gz")
    assert written("o/t", "sub/", "_x") == Path("o/sub/t_x")


def test_lists_and_variables_are_read_as_by_sumo(monkeypatch):
    monkeypatch.setenv("PART", "one two")
    assert listed(expand("${PART}.rou.xml, b;c.xml ,${NO_SUCH}d.xml")) == [
        "one two.rou.xml",
        "b;c.xml",
        "d.xml",
    ]


def test_what_is_changed_is_said(scenario_file):
    path = scenario_file('<random_number><seed value="5"/></random_number><time-to-teleport value="120"/>')
    told = {c.option: str(c) for c in changes(read_scenario(path, ["-e", "60"]), seed=None)}
    assert "time-to-teleport" not in told
    assert told["collision.action"].startswith("collision.action teleport -> warn (the scenario says nothing")
    assert told["end"] == "end 30 -> 60 (the command line says so)"
    assert "seed" not in told
    assert [c.option for c in changes(read_scenario(path), seed=7) if "seed" in c.option] == ["seed"]
    assert not [c for c in changes(read_scenario(path), seed=5) if "seed" in c.option]
    quiet = scenario_file('<report><collision.action value="warn"/></report>')
    assert [c.option for c in changes(read_scenario(quiet))] == ["collision.mingap-factor"]


def test_reports_that_are_silenced_are_said_and_may_be_asked_for(scenario_file, tmp_path):
    path = scenario_file('<report><verbose value="true"/></report>')
    assert "verbose true -> false (our own" in " ".join(map(str, changes(read_scenario(path))))
    scenario = read_scenario(path, ["--verbose"])
    assert values(command(scenario, tmp_path / "w"))["--verbose"] == "true"
    assert "verbose" not in {c.option for c in changes(scenario)}


def test_mistyped_options_get_the_nearest_names(scenario_file):
    with pytest.raises(PhaseError, match="fdc-output; did you mean --fcd-output"):
        read_scenario(scenario_file(), ["--fdc-output", "x.xml"])


def test_model_names():
    assert sumo_model("eidm") == "EIDM"
    with pytest.raises(PhaseError, match=r"idmx.*did you mean idm"):
        sumo_model("idmx")
