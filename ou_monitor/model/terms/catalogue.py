"""
All terms: the classes with a NAME in the modules of this folder, and causes of other packages.

Model files and findings use these names.  Other packages declare their causes as entry points of
the group `ou_monitor.causes`.  If such a cause cannot be used, the reason is reported, and
`discover` continues without the cause.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from pkgutil import iter_modules
import re
import traceback
from types import MappingProxyType

import ou_monitor.model.terms as folder
from ou_monitor.model.terms.term import Term
from ou_monitor.text import printable

GROUP = 'ou_monitor.causes'
# Maximum length of a sentence on a cause that was left out, characters.
_LONGEST = 200
# Causes of other packages that failed: name -> the reason, a sentence.
_left_out: dict[str, str] = {}


@cache
def catalogue() -> Mapping[str, type[Term]]:
    """Return all terms by name: first the `ou`, last the terms of other packages."""
    found: dict[str, type[Term]] = {}
    for info in iter_modules(folder.__path__):
        module = import_module(f'{folder.__name__}.{info.name}')
        for value in vars(module).values():
            if (isinstance(value, type) and issubclass(value, Term) and vars(value).get('NAME')
                    and value.__module__ == module.__name__):
                found[value.NAME] = value
    found = {'ou': found.pop('ou'), **dict(sorted(found.items()))}
    for entry in sorted(entry_points(group=GROUP), key=lambda one: one.name):
        if entry.name in _left_out:
            continue
        try:
            kind = entry.load()
            _check(kind, entry.name, found)
        # An error in another package must not end the command.
        except (Exception, SystemExit) as error:
            _leave_out(entry.name, error)
        else:
            found[entry.name] = kind
    return MappingProxyType(found)


def every_kind() -> list[type[Term]]:
    """Return all terms, each followed by its other forms."""
    return [form for kind in catalogue().values() for form in (kind, *kind.variants())]


def left_out() -> Mapping[str, str]:
    """Return a sentence for each cause of another package that cannot be used, by its name."""
    catalogue()
    return _left_out


def blamed(error: BaseException) -> tuple[str, ...]:
    """Return the causes of other packages whose code raised an error."""
    modules = set()
    cause: BaseException | None = error
    while cause is not None:
        modules |= {frame.f_globals.get('__name__')
                    for frame, _ in traceback.walk_tb(cause.__traceback__)}
        cause = cause.__cause__
    return tuple(name for name in _installed() if catalogue()[name].__module__ in modules)


def withdraw(error: BaseException) -> bool:
    """Remove the installed causes that raised an error, or else all; return whether any was."""
    names = blamed(error) or _installed()
    for name in names:
        _leave_out(name, error)
    catalogue.cache_clear()
    return bool(names)


def _installed() -> list[str]:
    return [name for name, kind in catalogue().items()
            if not kind.__module__.startswith(f'{folder.__name__}.')]


def _leave_out(name: str, error: BaseException) -> None:
    words = ' '.join(str(error).split())
    _left_out[name] = printable(
        f"The cause '{name}' of another package was left out: {type(error).__name__}"
        + (f': {words}' if words else ''), _LONGEST) + '.'


def _check(kind: object, name: str, known: Mapping[str, type[Term]]) -> None:
    """Raise an error unless `kind` is a valid cause of this name."""
    if not (isinstance(kind, type) and issubclass(kind, Term)):
        raise TypeError('it is not a class derived from Term')
    if name != kind.NAME or not re.fullmatch('[a-z][a-z0-9_]*', name) or name in known:
        raise ValueError(f"its NAME is '{kind.NAME}': it must be the name of the entry point, "
                         'in lower case, and not the name of another cause')
    if missing := [word for word in ('FAMILY', 'MEANING', 'REMEDY', 'SEPARATED_BY')
                   if not getattr(kind, word)]:
        raise ValueError(f"it has no {', '.join(missing)}")
    if unknown := {*kind.LINEAR, *kind.FREE}.difference(kind.parameters()):
        raise ValueError(f"{', '.join(sorted(unknown))} is in LINEAR or FREE, but not a parameter")
