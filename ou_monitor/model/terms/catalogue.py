"""
Every term there is, found by looking: a new class with a NAME in a module here is a term.

The names are those of model files and of findings.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from importlib import import_module
from pkgutil import iter_modules
from types import MappingProxyType

import ou_monitor.model.terms as folder
from ou_monitor.model.terms.term import Term


@cache
def catalogue() -> Mapping[str, type[Term]]:
    """Return all terms by name, the `ou` first."""
    found: dict[str, type[Term]] = {}
    for info in iter_modules(folder.__path__):
        module = import_module(f'{folder.__name__}.{info.name}')
        for value in vars(module).values():
            if (isinstance(value, type) and issubclass(value, Term) and value.NAME
                    and value.__module__ == module.__name__):
                found[value.NAME] = value
    return MappingProxyType({'ou': found.pop('ou'), **dict(sorted(found.items()))})
