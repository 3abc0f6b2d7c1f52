

def test_little_noise_on_fine_steps_costs_no_thousands_of_nodes(monkeypatch):
    """It moves the barrier by less than 5e-4 of a step from none, and takes few nodes."""
    orders = []
    legendre = sampled._legendre
    monkeypatch.setattr(sampled, '_legendre', lambda n: orders.append(n) or legendre(n))
    sampled._straight.cache_clear()
    found = [sampled.sampled_passage_probability(0.3, 0.5, 1e-5, 1000, part * math.sqrt(2e-5))
             for part in (0.0, 2e-4, 1e-3, 0.0199, 0.0201)]
    assert max(orders) < 300
    assert found == sorted(found) and found[-1] - found[0] < 5e-4 * math.sqrt(2e-5) * 10.0
