import io
import json
from dataclasses import replace

import pytest
import zmq
from rich.console import Console

from twin.station.doctor import (
    Machine,
    as_json,
    as_table,
    exit_code,
    find_browser,
    find_software_vulkan,
    run_checks,
)


@pytest.fixture
def complete(tmp_path):
    """A Linux machine that has everything."""
    drivers = tmp_path / "usr/share/vulkan/icd.d"
    drivers.mkdir(parents=True)
    (drivers / "intel_icd.json").touch()
    (drivers / "lvp_icd.json").touch()
    answer = tmp_path / "home/.config/rerun/analytics.json"
    answer.parent.mkdir(parents=True)
    answer.write_text('{"analytics_enabled": false}')
    viewer = tmp_path / "bin/rerun"
    viewer.parent.mkdir()
    viewer.touch(mode=0o755)
    package = tmp_path / "twin"
    package.mkdir()
    return Machine(
        python=(3, 12, 1),
        platform="linux",
        environ={"DISPLAY": ":0", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
        root=tmp_path,
        home=tmp_path / "home",
        scripts=tmp_path / "bin",
        package=package,
        here=tmp_path,
        requirements=lambda: ("numpy>=2.1", "rerun-sdk>=0.41,<0.42", 'tzdata; sys_platform == "nowhere"'),
        version_of={"numpy": "2.4.6", "rerun-sdk": "0.41.0"}.get,
        which={"chromium": "/usr/bin/chromium"}.get,
        free_bytes=lambda _: 10**11,
        loopback=lambda: None,
    )


def only_failure(machine):
    """The one check that fails on that machine."""
    (failure,) = [check for check in run_checks(machine) if not check.ok]
    assert failure.remedy, "a failure must say what to do"
    return failure


def test_nothing_is_left_to_do_on_a_complete_machine(complete):
    checks = run_checks(complete)
    assert all(check.ok and not check.remedy for check in checks)
    assert exit_code(checks) == 0
    assert "tzdata" not in {check.name for check in checks}, "a requirement of another platform"


def no_loopback():
    raise zmq.ZMQError(msg="no loopback here")


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"python": (3, 10, 13)}, "Python"),
        ({"version_of": {"rerun-sdk": "0.41.0"}.get}, "numpy"),
        ({"version_of": {"numpy": "2.4.6", "rerun-sdk": "0.42.1"}.get}, "rerun-sdk"),
        ({"requirements": tuple}, "atmd-twin"),
        ({"requirements": lambda: ("a b c",)}, "a b c"),
        ({"free_bytes": lambda _: 10**8}, "free disk"),
        ({"loopback": no_loopback}, "encrypted messages"),
    ],
)
def test_a_missing_requirement_fails_the_machine(complete, change, name):
    machine = replace(complete, **change)
    failure = only_failure(machine)
    assert (failure.name, failure.required) == (name, True)
    assert exit_code(run_checks(machine)) == 1


def test_a_viewer_that_cannot_be_executed_is_missing(complete):
    (complete.scripts / "rerun").chmod(0o644)
    assert only_failure(complete).name == "Rerun viewer"
    (complete.scripts / "rerun").unlink()
    assert only_failure(complete).required


def test_compiled_code_needs_one_writable_place(complete, tmp_path):
    blocked = tmp_path / "file"
    blocked.touch()
    nowhere = replace(
        complete, package=blocked, home=blocked, environ=complete.environ | {"XDG_CONFIG_HOME": ""}
    )
    failures = {check.name: check for check in run_checks(nowhere) if not check.ok}
    assert failures["compiled code"].required
    assert "NUMBA_CACHE_DIR" in failures["compiled code"].remedy
    helped = replace(nowhere, environ=nowhere.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "new")})
    assert "compiled code" not in {check.name for check in run_checks(helped) if not check.ok}


@pytest.mark.parametrize(
    ("change", "name", "remedy"),
    [
        ({"which": {}.get}, "browser for tests", "apt install chromium"),
        ({"environ": {"DISPLAY": ":0", "OMP_NUM_THREADS": "1"}}, "threads", "OPENBLAS_NUM_THREADS=1"),
        ({"environ": {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}}, "display", "headless"),
    ],
)
def test_what_is_optional_is_noted_and_the_machine_still_passes(complete, change, name, remedy):
    machine = replace(complete, **change)
    failure = only_failure(machine)
    assert (failure.name, failure.required) == (name, False)
    assert remedy in failure.remedy
    assert exit_code(run_checks(machine)) == 0


def test_a_driver_for_graphics_hardware_is_no_software_vulkan(complete, tmp_path):
    (tmp_path / "usr/share/vulkan/icd.d/lvp_icd.json").unlink()
    assert find_software_vulkan(complete) is None
    failure = only_failure(complete)
    assert "intel_icd.json" in failure.detail
    assert "mesa-vulkan-drivers" in failure.remedy
    elsewhere = tmp_path / "lvp.json"
    elsewhere.touch()
    told = replace(complete, environ=complete.environ | {"VK_DRIVER_FILES": str(elsewhere)})
    assert find_software_vulkan(told) == elsewhere


@pytest.mark.parametrize("platform", ["darwin", "win32"])
def test_desktop_systems_need_neither_display_variable_nor_vulkan(complete, tmp_path, platform):
    (tmp_path / "bin/rerun.exe").touch(mode=0o755)
    bare = replace(complete, platform=platform, root=tmp_path / "empty", environ={})
    names = {check.name for check in run_checks(bare) if not check.ok}
    assert not names & {"display", "pictures without a screen", "Rerun viewer"}


@pytest.mark.parametrize("answer", ['{"analytics_enabled": true}', "{}", "[]", "not json", None])
def test_usage_reports_count_as_on_unless_switched_off(complete, tmp_path, answer):
    path = tmp_path / "home/.config/rerun/analytics.json"
    path.unlink()
    if answer is not None:
        path.write_text(answer)
    failure = only_failure(complete)
    assert failure.name == "Rerun's usage reports"
    assert failure.remedy.endswith("rerun analytics disable")


def test_the_table_says_what_is_missing_and_what_to_do(complete):
    checks = run_checks(
        replace(complete, version_of={"rerun-sdk": "0.41.0"}.get, environ={"DISPLAY": "[bold]:0"})
    )
    out = io.StringIO()
    Console(file=out, width=200).print(as_table(checks))
    lines = out.getvalue().splitlines()
    assert any("missing" in line and "numpy" in line and "make clean demo" in line for line in lines)
    assert "[bold]:0" in out.getvalue(), "what a machine says is text, not markup"


def test_json_carries_every_check_and_the_verdict(complete):
    checks = run_checks(replace(complete, python=(3, 10, 0)))
    report = json.loads(json.dumps(as_json(checks)))
    assert report["ok"] is False
    assert report["checks"][0] == {
        "name": "Python",
        "ok": False,
        "required": True,
        "detail": "3.10.0",
        "remedy": checks[0].remedy,
    }
    assert len(report["checks"]) == len(checks)


def test_this_machine_can_run_the_program():
    failures = [check for check in run_checks() if check.required and not check.ok]
    assert not failures


def test_software_vulkan_and_a_browser_are_found_where_their_packages_are(requires_debian):
    assert requires_debian("mesa-vulkan-drivers") == find_software_vulkan()
    assert requires_debian("chromium") == find_browser()
