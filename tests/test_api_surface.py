"""The public names and what they take are frozen in ``api_surface.json``: a change there is a change for every user."""

import inspect
import json
from pathlib import Path

import geomtact

FROZEN = Path(__file__).parent / "api_surface.json"


def taken(something):
    """The names of what a call takes, with a default marked; None for what is not called."""
    try:
        parameters = inspect.signature(something).parameters.values()
    except (TypeError, ValueError):
        return None
    return [p.name if p.default is p.empty else f"{p.name}=" for p in parameters if p.name not in ("self", "cls")]


def surface():
    """Every public name of geomtact, what it takes, and of a class its public members."""
    out = {}
    for name in geomtact.__all__:
        value = getattr(geomtact, name)
        out[name] = {"takes": taken(value)} if callable(value) else {}
        if inspect.isclass(value) and not issubclass(value, Exception):
            members = [member for member in dir(value) if not member.startswith("_")]
            fields = list(getattr(value, "__dataclass_fields__", {}))
            out[name]["members"] = {
                member: taken(getattr(value, member, None)) if member not in fields else "field"
                for member in sorted({*members, *fields})
                if not member.startswith("_")
            }
    return out


def test_public_names_are_those_that_were_promised():
    """To change them on purpose: ``python tests/test_api_surface.py`` writes the file anew."""
    assert surface() == json.loads(FROZEN.read_text("utf-8"))


if __name__ == "__main__":
    FROZEN.write_text(json.dumps(surface(), indent=2, sort_keys=True) + "\n", "utf-8")
