"""Requirements of every page: one well-formed file that loads nothing from outside."""

import base64
import hashlib
import json
import re
from xml.etree import ElementTree
import zlib

import numpy as np

# Elements that load something with any attributes.
_LOADING = {'link', 'img', 'iframe', 'object', 'embed', 'audio', 'video', 'source', 'base',
            'image', 'use', 'a', 'form', 'input'}


def parsed(html):
    """Parse a page as XML: it must be well formed, without undefined entities."""
    return ElementTree.fromstring(html.replace('<!DOCTYPE html>\n', ''))


def self_contained(html):
    """Assert that a page loads nothing and runs only its own script; return its tree."""
    tree = parsed(html)
    data = [e for e in tree.iter('script') if e.get('type') == 'application/json']
    code = [e for e in tree.iter('script') if e.get('type') is None]
    assert len(data) + len(code) == len(list(tree.iter('script')))
    assert len(code) == (1 if data else 0)
    assert not _LOADING & {e.tag for e in tree.iter()}
    for e in tree.iter():
        wrong = [name for name in e.attrib if re.fullmatch(
            r'on\w+|.*src.*|.*href|action|data|background|poster', name)]
        assert not wrong, (e.tag, wrong)
        assert 'url(' not in e.get('style', '')
    style = ''.join(e.text for e in tree.iter('style'))
    assert not re.search(r'url\(|@import|https?:', style)
    source = "'none'"
    if code:
        text = re.search(r'<script>(.*?)</script>', html, re.DOTALL).group(1)
        assert not re.search(
            r'https?:|fetch|XMLHttp|WebSocket|EventSource|sendBeacon|import|eval|Function\(|'
            r'innerHTML|outerHTML|insertAdjacent|document\.write|\.src\b|href', text)
        digest = hashlib.sha256(text.encode()).digest()
        source = f"'sha256-{base64.b64encode(digest).decode()}'"
    (policy,) = [e.get('content') for e in tree.iter('meta')
                 if e.get('http-equiv') == 'Content-Security-Policy']
    assert policy == (f"default-src 'none'; script-src {source}; style-src 'unsafe-inline'; "
                      "base-uri 'none'; form-action 'none'")
    rest = re.sub(r'<script.*?</script>', '', html, flags=re.DOTALL)
    assert not re.search(r'https?:|//', rest)
    return tree


def unpacked(script):
    """Return the figure of a data script, its columns as arrays."""
    found = json.loads(re.fullmatch(r'<script[^>]*>(.*)</script>', script, re.DOTALL).group(1))
    block = zlib.decompress(base64.b64decode(found['block']))

    for curve in found['curves']:
        for name in ('x', 'y', 'high'):
            if curve[name] is not None:
                place, count = curve[name]
                curve[name] = np.frombuffer(block, '<f4', count, place).astype(np.float64)
    return found
