"""What implements a protocol, found in the package, so that a law holds for the next implementation too."""

import importlib
import inspect
import pkgutil
from types import ModuleType


def implementations(package: ModuleType, method: str) -> list[type]:
    """Every class defined in ``package`` or below that has ``method``, but for protocols themselves."""
    names = [each.name for each in pkgutil.walk_packages(getattr(package, "__path__", []), f"{package.__name__}.")]
    modules = [package, *map(importlib.import_module, names)]
    found = {
        each: None
        for module in modules
        for each in vars(module).values()
        if inspect.isclass(each) and each.__module__ == module.__name__ and method in vars(each)
    }
    return [each for each in found if not getattr(each, "_is_protocol", False)]
