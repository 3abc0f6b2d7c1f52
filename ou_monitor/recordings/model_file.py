"""
Model files: the terms of a supply as YAML.

`model:` is a list of terms, each `{term: NAME, params: {...}, se: {...}}`, the first being `ou`;
`load:` (optional) holds start values of the load filter; `full_load_a:` (optional) is the current
at which the load is 1, A, if the load is a current; `provenance:` is free text. `discover` and
`simulate` write model files; `simulate`, `compare` and the nodes read them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import chain, repeat
import math
from pathlib import Path
import re
from typing import Any

from ou_monitor.errors import InputError, nearest
from ou_monitor.model.load import LoadStart
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.catalogue import catalogue, left_out
from ou_monitor.model.terms.term import Term
from ou_monitor.records import plain_data
from ou_monitor.stream.files import one_line, path_words, read_yaml
import yaml

_KEYS = ('model', 'load', 'full_load_a', 'provenance')
_TERM_KEYS = ('term', 'params', 'se')
_DAY = re.compile(r'\d{4}-\d\d-\d\d')
_EXPONENT = re.compile(r'[-+]?\d+(\.\d*)?[eE][-+]?\d{1,3}')


@dataclass(frozen=True)
class ModelFile:
    """Content of a model file."""

    model: SupplyModel
    # Standard errors by parameter, in its unit, one dict for each term; empty if unknown.
    se: tuple[dict[str, Any], ...] = ()
    # Recording, commit, date, held-out score; free text.
    provenance: dict[str, Any] = field(default_factory=dict)


@one_line()
def read_model(path: str | Path) -> ModelFile:
    """Read a model file; 1 MB, the maximum, takes 2 to 5 s, so nodes read it in a thread."""
    return parse_model(read_yaml(path, 'the model file'), path_words(path))


def parse_model(data: Any, where: str) -> ModelFile:
    """Return the model in parsed YAML."""
    if not isinstance(data, dict) or 'model' not in data:
        raise InputError(f"{where}: a model file needs 'model:', a list of terms")
    for key in data:
        if key not in _KEYS:
            raise InputError(f"{where}: unknown entry '{key}': {nearest(str(key), _KEYS)}")
    entries = data['model']
    if not isinstance(entries, list):
        raise InputError(f"{where}: 'model' must be a list of terms, got "
                         f'{type(entries).__name__}')
    terms = [_term(entry, f'{where}, term {k}') for k, entry in enumerate(entries, start=1)]
    provenance = data.get('provenance') or {}
    if not isinstance(provenance, dict):
        raise InputError(f"{where}: 'provenance' must be a mapping")
    try:
        model = SupplyModel(tuple(term for term, _ in terms), _load(data.get('load')),
                            _date(provenance.get('date')), _full(data.get('full_load_a')))
    except ValueError as error:
        raise InputError(f'{where}: {error}') from error
    return ModelFile(model, tuple(se for _, se in terms), provenance)


def _date(entry: Any) -> str:
    """Return a day, which YAML may have read as a date; empty for free text."""
    text = str(entry)[:10]
    return text if _DAY.fullmatch(text) else ''


def _full(entry: Any) -> float:
    """Return the entry `full_load_a`, A; 0 for null."""
    value = _numbers(entry)
    if value is None:
        return 0.0
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not (
            0.0 < abs(value) < math.inf):
        raise ValueError(f"'full_load_a' must be a current in A other than 0, got {entry!r}")
    return float(value)


def _load(entry: Any) -> LoadStart | None:
    """Return the entry `load`; None for null."""
    if entry is None:
        return None
    if not isinstance(entry, dict):
        raise ValueError("'load' must be a mapping")
    return LoadStart.read({str(k): _numbers(v) for k, v in entry.items()})


def _term(entry: Any, where: str) -> tuple[Term, dict[str, Any]]:
    if not isinstance(entry, dict) or 'term' not in entry:
        raise InputError(f"{where}: a term needs 'term: NAME' and 'params:'")
    name = str(entry['term'])
    terms = catalogue()
    if name not in terms:
        why = left_out().get(name) or nearest(name, terms)
        raise InputError(f"{where}: unknown term '{name}': {why}")
    for key in entry:
        if key not in _TERM_KEYS:
            raise InputError(f"{where} ('{name}'): unknown entry '{key}': "
                             f'{nearest(str(key), _TERM_KEYS)}')
    params, se = entry.get('params') or {}, entry.get('se') or {}
    for what, values in (('params', params), ('se', se)):
        if not isinstance(values, dict):
            raise InputError(f"{where} ('{name}'): '{what}' must be a mapping of names to numbers")
    for key in se:
        if key not in terms[name].parameters():
            raise InputError(f"{where} ('{name}'): 'se' names '{key}', which is not a parameter: "
                             f'{nearest(str(key), terms[name].parameters())}')
    try:
        return (terms[name].read({k: _numbers(v) for k, v in params.items()}),
                {k: _error(f'{name}.{k}', _numbers(v)) for k, v in se.items()})
    except ValueError as error:
        raise InputError(f'{where}: {error}') from error


def _numbers(value: Any) -> Any:
    """Return a value with texts such as 1e-3 as numbers (YAML 1.1 requires a point: 1.0e-3)."""
    if isinstance(value, list):
        return [_numbers(v) for v in value]
    return float(value) if isinstance(value, str) and _EXPONENT.fullmatch(value) else value


def _error(name: str, value: Any) -> Any:
    """Return a standard error, or a list of them; null means unknown."""
    if isinstance(value, list):
        return [_error(name, v) for v in value]
    if value is None:
        return math.nan
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not (
            0.0 <= value < math.inf):
        raise ValueError(f'the standard error of {name} must be null or a number, at least 0, '
                         f'got {value!r}')
    return float(value)


def as_yaml(file: ModelFile) -> str:
    """Return the text of a model file; `parse_model` gives the same model back."""
    data: dict[str, Any] = {'model': [
        {'term': term.NAME, 'params': plain_data(term.values())}
        | ({'se': plain_data(se)} if se else {})
        for term, se in zip(file.model.terms, chain(file.se, repeat({})))]}
    if file.model.load is not None:
        data['load'] = file.model.load.values()
    if file.model.full_current:
        data['full_load_a'] = file.model.full_current
    if file.provenance:
        data['provenance'] = dict(file.provenance)
    text: str = yaml.safe_dump(data, sort_keys=False, allow_unicode=True)
    return text
