"""The plan of the house: data walks one way, imports are light, and the library neither prints nor pickles."""

import ast
import configparser
import importlib.util
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "geomtact"
MODULES = sorted(PACKAGE.rglob("*.py"))
RUN_BY_HAND = {"film.py", "figures.py"}  # programs that print and draw, as the examples do
STUDIES = sorted(path for path in (ROOT / "tools" / "studies").rglob("*.py") if path.name not in RUN_BY_HAND)
SCRIPTS = [path for folder in ("tools", "docs/examples", "meshes") for path in sorted((ROOT / folder).rglob("*.py"))]

# A module imports only from its own stage and from stages above it in this list; one line, one height.
STAGES = [
    ["errors", "files", "log_mass", "progress", "se3", "threads", "versions"],
    ["json_values"],
    ["geometry"],
    ["sensing"],
    ["kernels"],
    ["contact_space"],
    ["scoring"],
    ["registration"],
    ["inference"],
    ["planning"],
    ["localizer"],
    ["identification"],
    ["training"],
    ["batch", "evaluation"],
    ["report"],
    ["cli"],
]
HEIGHT = {name: k for k, names in enumerate(STAGES) for name in names}
WRITERS = {"write_text", "write_bytes", "savefig"}
FORBIDDEN = {"pymeshlab", "tamaas", "pickle", "cloudpickle", "joblib"}
HEAVY = {"torch", "open3d", "matplotlib", "trimesh", "skimage", "cv2", "kornia", "scipy.spatial", "numpy", "PIL"}
SHOW_HELP = "import sys; sys.argv = ['geomtact', '--help']; from geomtact.cli import main; main()"


def stage(path: Path) -> str:
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


@cache
def parsed(path: Path) -> list[ast.AST]:
    return list(ast.walk(ast.parse(path.read_text("utf-8"))))


def nodes(paths: list[Path]) -> Iterator[tuple[Path, ast.AST]]:
    """Every node of every file's syntax tree, with the file."""
    return ((path, node) for path in paths for node in parsed(path))


def imports(path: Path) -> list[tuple[str, int]]:
    """Every module named by an import anywhere in a file, and its line; ``from geomtact import x`` names geomtact.x."""
    found = []
    for _, node in nodes([path]):
        if isinstance(node, ast.Import):
            found += [(alias.name, node.lineno) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: relative import"
            module = node.module or ""
            names = [f"geomtact.{alias.name}" for alias in node.names] if module == "geomtact" else [module]
            found += [(name, node.lineno) for name in names]
    return found


def test_imports_go_one_way():
    offences = []
    for path in MODULES:
        own = stage(path)
        for name, line in imports(path):
            parts = name.split(".")
            if parts[0] in FORBIDDEN:
                offences.append(f"{path}:{line} imports {name}")
            if parts[0] != "geomtact" or len(parts) == 1 or own in ("__init__", "__main__"):
                continue
            if parts[1] not in HEIGHT:
                offences.append(f"{path}:{line}: {name} is in no stage; add its folder to STAGES")
            elif not (parts[1] == own or HEIGHT[parts[1]] < HEIGHT[own] or {own, parts[1]} == {"errors", "se3"}):
                offences.append(f"{path}:{line}: {own} imports from {parts[1]}, a later stage")
    assert not offences, "\n".join(offences)


def test_no_two_modules_import_each_other():
    """Not by way of others either, within a folder, within a function, or for types alone."""
    name_of = {path: "geomtact." + ".".join(path.relative_to(PACKAGE).with_suffix("").parts) for path in MODULES}
    apart = [path for path in MODULES if path.name not in ("__init__.py", "__main__.py")]
    graph = {name_of[path]: {name for name, _ in imports(path)} for path in apart}
    for path, node in nodes(apart):
        if isinstance(node, ast.ImportFrom):  # ``from geomtact.sensing import noise`` names a module
            graph[name_of[path]] |= {f"{node.module}.{alias.name}" for alias in node.names}
    left = {name: targets & set(graph) for name, targets in graph.items()}
    while free := {name for name, targets in left.items() if not targets}:
        left = {name: targets - free for name, targets in left.items() if name not in free}
    assert not left, f"these modules import each other, or one that does: {sorted(left)}"


def test_no_module_uses_another_ones_private_names():
    """A private attribute belongs to what the module itself defines; a private name is not imported."""
    offences = []
    for path in [*MODULES, *STUDIES]:
        own = {node.name for node in parsed(path) if isinstance(node, ast.FunctionDef)}
        own |= {
            node.attr for node in parsed(path) if isinstance(node, ast.Attribute) and ast.unparse(node.value) == "self"
        }
        for node in parsed(path):
            if isinstance(node, ast.ImportFrom):
                private = [alias.name for alias in node.names if re.match("_[a-zA-Z]", alias.name)]
                offences += [f"{path}:{node.lineno} imports {name}" for name in private]
            elif isinstance(node, ast.Attribute) and re.match("_[a-zA-Z]", node.attr) and node.attr not in own:
                offences.append(f"{path}:{node.lineno} uses {ast.unparse(node)} of another module")
    assert not offences, "\n".join(offences)


def test_what_scripts_import_is_there():
    """Inside functions, too: most scripts run for too long to be run here."""
    offences = []
    for path, node in nodes(SCRIPTS):
        if isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] in ("geomtact", "tools"):
            module = importlib.import_module(node.module)
            offences += [
                f"{path}:{node.lineno}: no {alias.name} in {node.module}"
                for alias in node.names
                if not (hasattr(module, alias.name) or importlib.util.find_spec(f"{node.module}.{alias.name}"))
            ]
    assert not offences, "\n".join(offences)


def test_library_does_not_print():
    offences = [
        f"{path}:{node.lineno} prints; return it, or say it in geomtact/cli"
        for path, node in nodes([*MODULES, *STUDIES])
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "print"
    ]
    assert not offences, "\n".join(offences)


def test_files_are_written_whole_or_not_at_all():
    """Under a temporary name (``geomtact.files``), or within a folder that is renamed as a whole."""
    offences = []
    for path, node in nodes([*MODULES, *STUDIES]):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in WRITERS:
            into = ast.unparse(node.args[0] if node.func.attr == "savefig" else node.func.value)
            if into.split(" ")[0] not in ("temporary", "building"):
                offences.append(f"{path}:{node.lineno} writes {into} in place")
    assert not offences, "\n".join(offences)


def test_committed_results_are_of_studies_as_they_are_now():
    """By their schema: what is written today would be resumed, and its fields are those that the pages describe."""
    sources = [*MODULES, *(ROOT / "tools").rglob("*.py")]
    known = {name for path in sources for name in re.findall(r'"(geomtact/[a-z-]+/\d+)"', path.read_text("utf-8"))}
    files = sorted((ROOT / "docs" / "results").glob("*.json"))
    schemas = {path.name: json.loads(path.read_text("utf-8")).get("schema") for path in files}
    assert len(schemas) > 10
    told_apart = {name for name, schema in schemas.items() if schema is None}
    assert told_apart <= {"benchmark.json", "peers.json", "thesis_figures.json"}  # which nothing resumes
    assert {name: schema for name, schema in schemas.items() if schema is not None and schema not in known} == {}


@pytest.mark.parametrize("command", ["import geomtact", SHOW_HELP])
def test_start_is_light(command):
    """Loading nothing heavy is what makes the start quick, whatever the machine does meanwhile."""
    done = subprocess.run(
        [sys.executable, "-X", "importtime", "-c", command], capture_output=True, text=True, check=True
    )
    loaded = {line.split("|")[-1].strip() for line in done.stderr.splitlines() if line.startswith("import time:")}
    assert "geomtact" in loaded
    assert not loaded & HEAVY


def test_public_names_are_the_promised_ones():
    import geomtact

    promised = {"Localizer", "Posterior", "Mode", "Sensor", "contact_mask", "Contact", "GeomtactError", "load_mesh"}
    assert promised <= set(geomtact.__all__)
    assert sorted(geomtact.__all__) == dir(geomtact)
    for name in geomtact.__all__:
        assert getattr(geomtact, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'localiser'"):
        geomtact.localiser  # noqa: B018


def test_every_error_is_a_geomtact_error():
    from geomtact import errors

    classes = [c for c in vars(errors).values() if isinstance(c, type) and c.__module__ == errors.__name__]
    assert len(classes) > 3
    assert all(issubclass(c, errors.GeomtactError) for c in classes)


def test_setup_cfg_ships_every_package_and_pins_every_requirement():
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg", "utf-8")
    packages = config["options"]["packages"].split()
    folders = {".".join(p.parent.relative_to(ROOT).parts) for p in PACKAGE.rglob("__init__.py")}
    assert set(packages) == folders | {"geomtact_meshes"}
    assert all(p.parent.joinpath("__init__.py").is_file() for p in MODULES)

    wanted = config["options"]["install_requires"] + "\n".join(config["options.extras_require"].values())
    names = {line.split(">")[0].split("=")[0].strip() for line in wanted.splitlines() if line.strip()}
    lines = (ROOT / "tools" / "constraints.txt").read_text("utf-8").splitlines()
    pins = dict(line.split("==") for line in lines if line and not line.startswith("#"))
    assert names <= set(pins)
    assert pins["torch"] == "2.13.0"


def test_every_study_stands_in_its_table_and_has_its_folder():
    import tools.studies
    from tools.studies.__main__ import COMMANDS

    table = set(re.findall(r"^``([a-z-]+)``", tools.studies.__doc__, re.MULTILINE))
    folders = {path.parent.name for path in STUDIES if path.name == "command.py"}
    assert table == set(COMMANDS) - {"plot"}
    assert folders == {name.replace("-", "_") for name in table}
