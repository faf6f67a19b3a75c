"""Colours graphs with three colours: an energy of local terms, and four ways to search.

Simulated annealing by hand, which evaluates as many colours of nodes, stands beside them.
"""

import jax
import jax.numpy as jnp
import numpy as np

import leapjax as leap

NODES, EDGES, COLOURS, GRAPHS = 30, 68, 3, 64


def draw_graph(rng):
    """Draws edges `[EDGES, 2]` of a graph that some colouring solves."""
    colours = rng.integers(COLOURS, size=NODES)
    pairs = np.array([(a, b) for a in range(NODES) for b in range(a) if colours[a] != colours[b]])
    return pairs[rng.choice(len(pairs), EDGES, replace=False)]


def encode(params, edges):
    return leap.Factors(edges)  # a term for each edge, which reads the colours of its two nodes


def clash(params, data, colours):  # of one edge, colours [2]
    return jnp.where(colours[0] == colours[1], 1.0, 0.0)


def anneal(edges, rng, proposals):
    """Proposes colours of nodes, while it gets colder; returns the number of clashes."""
    around = [edges[(edges == node).any(axis=1)].sum(axis=1) - node for node in range(NODES)]
    colours = rng.integers(COLOURS, size=NODES)
    for temperature in np.linspace(0.6, 0.1, proposals):
        node, colour = rng.integers(NODES), rng.integers(COLOURS)
        others = colours[around[node]]
        worse = np.sum(others == colour) - np.sum(others == colours[node])
        if rng.random() < np.exp(-worse / temperature):
            colours[node] = colour
    return np.sum(colours[edges[:, 0]] == colours[edges[:, 1]])


rng = np.random.default_rng(0)
graphs = np.stack([draw_graph(rng) for _ in range(GRAPHS)])
degree = max(np.bincount(edges.reshape(-1)).max() for edges in graphs)
energy = leap.from_factors(encode, clash, COLOURS, int(degree))

steps = 20 * NODES
searches = {
    "Gibbs, last plan": leap.GibbsConfig(NODES, steps, temperature=0.3, score=True),
    "Gibbs, best plan": leap.GibbsConfig(NODES, steps, temperature=0.3, keep="best", score=True),
    "cooled": leap.GibbsConfig(NODES, steps, temperature=0.6, cool_to=0.1, score=True),
    "cooled, best of 8": leap.GibbsConfig(
        NODES, steps, temperature=0.6, cool_to=0.1, restarts=8, score=True
    ),
}
keys = jax.random.split(jax.random.key(0), GRAPHS)
for name, config in searches.items():
    plans = leap.compile_planner(energy, config)((), keys, graphs)
    print(f"{name:20} {np.mean(plans.energy == 0):4.0%} of {GRAPHS} graphs coloured")
clashes = np.array([anneal(edges, rng, COLOURS * steps) for edges in graphs])
print(f"{'annealed by hand':20} {np.mean(clashes == 0):4.0%}")
