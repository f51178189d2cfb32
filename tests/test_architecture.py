"""The tree is the architecture: who may import what."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("drivers", "calibration", "robominer_slam", "sim_backend")

#: Modules that read or write anything: devices, files, networks, databases, terminals.
IO_MODULES = {
    "serial", "usb", "zenoh", "sqlite3", "sqlite_utils", "socket", "selectors", "subprocess", "mcap", "click", "rich",
    "pathlib", "shutil", "tempfile", "io", "os", "matplotlib",
}  # fmt: skip

#: Folders and files that compute and do nothing else.
PURE = (
    "calibration",
    "robominer_slam/contacts.py",
    "robominer_slam/estimation",
    "robominer_slam/float_array.py",
    "robominer_slam/frame_result.py",
    "robominer_slam/geometry.py",
    "robominer_slam/layout.py",
    "robominer_slam/load_shedding.py",
    "robominer_slam/map_pose.py",
    "robominer_slam/mapping",
    "robominer_slam/pipeline.py",
    "robominer_slam/reorder.py",
    "robominer_slam/slam",
    "robominer_slam/evaluation/acceptance.py",
    "robominer_slam/evaluation/consistency.py",
    "robominer_slam/evaluation/height_errors.py",
    "robominer_slam/evaluation/metrics.py",
    "robominer_slam/evaluation/pose_graph_errors.py",
    "robominer_slam/evaluation/run_record.py",
    "robominer_slam/evaluation/trajectory.py",
    "drivers/arrival_clock.py",
    "drivers/bno08x_rvc.py",
    "drivers/clock.py",
    "drivers/decoders.py",
    "drivers/device.py",
    "drivers/device_time.py",
    "drivers/framed.py",
    "drivers/measurement.py",
    "drivers/mip.py",
    "drivers/readings.py",
    "drivers/rm3_compressed.py",
    "drivers/rm3_motor.py",
    "drivers/rm3_plaintext.py",
    "drivers/rm3_values.py",
    "drivers/spherical.py",
)

#: What the algorithms may take from the drivers: the type of a measurement.
DRIVERS_FOR_ALGORITHMS = {"drivers.measurement"}
ALGORITHMS = ("calibration", "robominer_slam/estimation", "robominer_slam/slam", "robominer_slam/mapping")


def imports(path: Path) -> set[str]:
    """Full names of the modules that a file imports, also inside functions."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module)
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def files(place: str) -> list[Path]:
    path = ROOT / place
    found = sorted(path.rglob("*.py")) if path.is_dir() else [path]
    assert found, place
    return found


def packages_of(names: set[str]) -> set[str]:
    return {name.split(".")[0] for name in names}


@pytest.mark.parametrize("place", PURE)
def test_algorithms_import_no_io(place: str):
    for path in files(place):
        wrong = packages_of(imports(path)) & IO_MODULES
        assert not wrong, f"{path.relative_to(ROOT)} imports {wrong}"


def test_drivers_know_nothing_of_slam():
    for path in files("drivers"):
        assert not packages_of(imports(path)) & {"robominer_slam", "calibration", "sim_backend"}, path


def test_calibration_stands_alone():
    for path in files("calibration"):
        assert not packages_of(imports(path)) & {"robominer_slam", "drivers", "sim_backend"}, path


def test_nothing_outside_the_simulator_imports_it():
    for package in ("drivers", "calibration", "robominer_slam"):
        for path in files(package):
            assert "sim_backend" not in packages_of(imports(path)), path


def test_algorithms_take_only_measurements_from_the_drivers():
    for place in ALGORITHMS:
        for path in files(place):
            used = {name for name in imports(path) if name.startswith("drivers.")}
            used = {".".join(name.split(".")[:2]) for name in used}
            assert used <= DRIVERS_FOR_ALGORITHMS, f"{path.relative_to(ROOT)} imports {used}"


def test_io_imports_no_algorithms():
    algorithms = {"robominer_slam.slam", "robominer_slam.estimation", "robominer_slam.mapping"}
    for place in ("drivers", "robominer_slam/publishing", "robominer_slam/sources"):
        for path in files(place):
            used = {".".join(name.split(".")[:2]) for name in imports(path)}
            assert not used & algorithms, f"{path.relative_to(ROOT)} imports {used & algorithms}"


def test_keys_know_nothing_of_slam():
    allowed = {
        "robominer_slam.security",
        "robominer_slam.publishing",
        "robominer_slam.configuration",
        "robominer_slam.doctor",
    }
    # The doctor holds the calibration against the layout.
    for place, more in (("robominer_slam/security", set()), ("robominer_slam/doctor", {"robominer_slam.layout"})):
        for path in files(place):
            used = {".".join(name.split(".")[:2]) for name in imports(path) if name.startswith("robominer_slam.")}
            used -= more
            assert used <= allowed, f"{path.relative_to(ROOT)} imports {used - allowed}"


def test_the_robot_needs_no_cryptography():
    """Only who issues keys does; `certificates.py` is imported when a certificate is made."""
    for package in PACKAGES:
        for path in files(package):
            if path.name != "certificates.py":
                assert "cryptography" not in packages_of(imports(path)), path


def test_the_simulator_shares_no_code_with_the_decoders():
    decoders = (
        "drivers.framed", "drivers.readings", "drivers.decoders", "drivers.rm3_", "drivers.bno08x_rvc", "drivers.mip",
        "drivers.spherical",
    )  # fmt: skip
    for path in files("sim_backend"):
        wrong = {name for name in imports(path) if name.startswith(decoders)}
        assert not wrong, f"{path.relative_to(ROOT)} imports {wrong}"


def test_simulation_only_libraries_stay_in_the_simulator():
    for package in ("drivers", "calibration", "robominer_slam"):
        for path in files(package):
            assert not packages_of(imports(path)) & {"mujoco", "magpylib"}, path


#: Of the operator's console: what lays out and serves the page, and what is below it.
PAGE = {
    "command_panel", "components", "page", "web_server", "whisker_history", "saved_maps_panel", "access", "stream",
}  # fmt: skip
WEB_MODULES = {"nicegui", "fastapi", "starlette", "uvicorn"}


def test_only_the_operators_page_knows_the_web():
    for package in PACKAGES:
        for path in files(package):
            page = path.parent.name == "operator" and path.stem in PAGE
            assert page or not packages_of(imports(path)) & WEB_MODULES, path


def test_the_consoles_page_and_its_link_do_not_know_each_other():
    for path in files("robominer_slam/operator"):
        used = {name.split(".")[2] for name in imports(path) if name.startswith("robominer_slam.operator.")}
        if path.stem in PAGE:
            assert not used & {"link", "recording_source"}, path
            assert "zenoh" not in packages_of(imports(path)), path
        else:
            assert not used & PAGE, path


def test_the_daemon_does_without_the_console():
    for path in files("robominer_slam"):
        if path.parent.name != "operator" and path != ROOT / "robominer_slam/cli/operator.py":
            assert not any(name.startswith("robominer_slam.operator") for name in imports(path)), path


def test_development_oracles_are_not_used_by_the_program():
    for package in PACKAGES:
        for path in files(package):
            assert not packages_of(imports(path)) & {
                "evo",
                "gtsam",
                "hypothesis",
                "pytest",
                "mcap_ros2",
                "playwright",
            }, path
