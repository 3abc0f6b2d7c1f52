"""Figures of a soak: dips in time, missed or lost, silence, memory, and false flags."""

import math

import numpy as np
import pytest
from soak import dips_of, false_of, growth, Heard, overlap, Said, silence, State, unheard
from soak_source import (
    bad_parameters, DEPTH, Dip, dips, events, LEAVE, Phase, phases, SEEN, SETTLE, UNSEEN)

FLOOR = 'the voltage is at or below brownout.floor (4.3 V)'


def heard(critical=(), lost=0, flags=None, stops=(), reason=FLOOR, counted=0, dropped=(),
          unsaid=(), backlog=0):
    """Return 20 s of states at 10 Hz; CRITICAL at some of them; one dip from 10 to 10.05 s."""
    # `lost`: messages that did not reach the node; `backlog`: of those before, which came now;
    # `counted`: dips by its count; `dropped`, `unsaid`: times of states and flags that did not
    # reach the listener.
    times = np.arange(0.0, 20.0, 0.1).round(3).tolist()
    states = [State(t, 'CRITICAL' if t in critical else 'OK', reason if t in critical else '',
                    'true' if t in critical else 'false',
                    round(1000.0 * t) + (backlog - lost) * (t > 10.0), lost * (t > 10.0),
                    counted * (t > 10.0), k)
              for k, t in enumerate(times) if t not in dropped]
    said = [Said(t, t in (critical if flags is None else flags), k)
            for k, t in enumerate(times) if t not in unsaid]
    return Heard(states=states, flags=said, stops=list(stops), source=[
        *({'kind': 'sent', 'at': t, 'count': round(1000.0 * t)} for t in (0.0, 20.0)),
        {'kind': 'dip', 'begin': 10.0, 'end': 10.05, 'samples': 50, 'phase': 'good',
         'unseen': '', 'voltage': 3.0}])


@pytest.mark.parametrize('made, fate', [
    (heard([10.1]), 'in_time'),
    (heard(), 'missed'),
    # For another reason; said before the dip; not said on the other topic; too late.
    (heard([10.1], reason='risk 0.5'), 'missed'),
    (heard([9.9]), 'missed'),
    (heard([10.1], flags=[]), 'missed'),
    (heard([11.2], counted=1), 'missed'),
    # Stopped by us meanwhile.
    (heard([11.2], stops=[(10.1, 10.6)]), 'in_time'),
    # Gone: more than half of its samples, or fewer.
    (heard(lost=46), 'lost'),
    (heard(lost=24), 'missed'),
    # By the node's numbers, though as many came from before.
    (heard(backlog=100, lost=46), 'lost'),
    (heard(backlog=100), 'missed'),
    # Counted by the node: the message was lost, of the state or of the flag; or nothing was.
    (heard([10.1], counted=1, dropped=[10.1]), 'unheard'),
    (heard([10.1], counted=1, unsaid=[10.1]), 'unheard'),
    (heard([10.1], counted=1, flags=[], dropped=[10.2]), 'missed'),
    (heard(counted=1), 'missed'),
    # A message was lost, but the node counted nothing.
    (heard(dropped=[10.1]), 'missed'),
])
def test_a_dip_counts_as_reported_within_a_second(made, fate):
    """The floor reports it on both topics, within a second of the node's own time."""
    found = dips_of(made)
    kinds = ('lost', 'unheard', 'missed')
    counts = {'in_time': found['in_time'], **{kind: len(found[kind]) for kind in kinds}}
    assert found['asked'] == 1 and counts == {kind: kind == fate for kind in counts}


@pytest.mark.parametrize('change', [{'unseen': 'silent'}, {'samples': 39}])
def test_dips_that_the_node_cannot_see_do_not_count(change):
    """Nor those of which too few samples were sent."""
    made = heard()
    made.source[-1].update(change)
    assert dips_of(made)['asked'] == 0


def test_silence_excludes_the_time_of_stops():
    stops = [(1.0, 1.9), (1.95, 2.0)]
    assert overlap(0.5, 1.97, stops) == pytest.approx(0.92)
    assert overlap(2.0, 3.0, stops) == 0.0
    said = [Said(at, None, k) for k, at in enumerate([0.0, 0.5, 2.0, 3.2])]
    gap, net = silence(said, stops)
    assert (gap, net) == (pytest.approx(1.5), pytest.approx(1.2))
    # A gap with a message that the listener lost does not count.
    assert unheard([*said, Said(9.0, None, 5)]) == 1
    assert silence([*said, Said(9.0, None, 5)], stops) == (gap, net)


def test_overlapping_pauses_count_once():
    made = heard([11.4], stops=[(10.1, 10.3)])
    made.withheld = [(5.0, 6.0), (10.2, 10.6)]
    assert made.pauses() == [(5.0, 6.0), (10.1, 10.6)]
    assert dips_of(made)['in_time'] == 1
    made.withheld = []
    assert dips_of(made)['in_time'] == 0


def test_false_flags_are_counted_while_the_input_is_unusable():
    """They count from when the node may no longer report what came before the phase."""
    made = heard([10.1])
    made.source = [{'kind': 'phase', 'name': 'silent', 'at': 5.0},
                   {'kind': 'phase', 'name': 'good', 'at': 8.05}]
    spent, found = false_of(made)
    assert spent == 1 and len(found) == 7 and found[0] == (pytest.approx(7.4), 'silent')
    made.flags = [flag for flag in made.flags if not 7.45 < flag.at < 7.65]
    assert len(false_of(made)[1]) == 5


def test_growth_is_within_its_error():
    """Correlated noise of 1 MB on 3 MB/h: 95 of 100 hours within two errors, and 0 outside."""
    rng = np.random.default_rng(3)
    t = np.arange(0.0, 3600.0, 2.0)
    scores = []
    for _ in range(100):
        noise = np.repeat(rng.standard_normal(t.size // 20), 20) * 1e6
        slope, error = growth(list(zip(t, 170e6 + 3e6 / 3600.0 * t + noise)))
        scores.append((slope - 3e6) / error)
        assert abs(slope - 3e6) < 2e6
    # Of t with 18 degrees of freedom: 1.06 expected, 3 standard errors of a standard deviation.
    assert np.std(scores) == pytest.approx(1.06, abs=3.0 * 1.1 / math.sqrt(200.0))
    assert math.isnan(growth([(0.0, 1.0)])[0])


def test_the_schedule_is_drawn_from_its_seed():
    """All that can happen does within an hour; dips lie apart, at or below every floor."""
    sent = phases(4, 3600.0)
    assert sent == phases(4, 3600.0) != phases(5, 3600.0)
    assert {phase.kind for phase in sent} == SEEN.keys() | UNSEEN.keys()
    assert all(a.end == b.begin for a, b in zip(sent, sent[1:]))
    found = dips(4, sent)
    assert found == dips(4, sent) and len(found) > 900
    assert all(0.04 <= dip.length <= 0.08 and DEPTH[0] <= dip.voltage <= DEPTH[1] < 4.15
               for dip in found)
    assert 0.75 < sum(not dip.unseen for dip in found) / len(found) < 0.98
    done = events(4, 3600.0, 'fifo', 'model')
    assert {event.kind for event in done} == {'set', 'refused', 'clear', 'slices', 'busy'}
    assert {event.about[0][0] for event in done if event.kind == 'refused'} == {
        name for name, _ in bad_parameters('fifo')}


def test_a_dip_is_unseen_where_nothing_is_sent():
    """And until a new publisher is found; what came before a silence counts."""
    for kind, before, after in (('restart', LEAVE, SETTLE), ('silent', 0.1, 0.1)):
        sent = [Phase('good', 0.0, 100.0), Phase(kind, 100.0, 102.0), Phase('good', 102.0, 200.0)]
        for dip in dips(1, sent, dense=True):
            near = dip.begin + dip.length > 100.0 - before and dip.begin < 102.0 + after
            assert dip.unseen == (kind if near else 'start' if dip.begin < 3.0 else '')
    assert isinstance(dips(1, sent)[0], Dip)
    assert len(dips(1, sent, dense=True)) > 1.7 * len(dips(1, sent))
