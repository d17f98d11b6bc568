"""Division of a drive into windows of blocks.

In a window the filter works on the local state alone: the vehicle and the nodes that either axle
passes. Nodes enter and leave the state between windows, and most heights are emitted there.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from estimators.kalman.tuning import TUNING


@dataclass(frozen=True, eq=False)
class WindowSchedule:
    """W windows in order. `edges` (W + 1,): the first block of each, and the number of blocks.

    Node numbers: `newest` (W,) held in a window, of `n_nodes`; `initial`, the newest before the
    first window; the local state has `n_front` (W,) nodes from the newest on, and `n_rear` (W,)
    from `rear_newest` (W,) on. `rear` (W,): the last node that the rear axle has passed whole.
    `reached` (J + 1,): the newest node that the front axle has touched after so many blocks.
    """

    edges: np.ndarray
    newest: np.ndarray
    initial: int
    n_nodes: int
    n_front: np.ndarray
    n_rear: np.ndarray
    rear_newest: np.ndarray
    rear: np.ndarray
    reached: np.ndarray

    @classmethod
    def divide(
        cls,
        front_node: np.ndarray,
        steps_per_block: int,
        wheelbase_nodes: float,
        max_advance: float,
        increment_span: int,
        held_nodes: int,
    ) -> "WindowSchedule":
        """Divide a drive into windows in which the vehicle moves `max_advance` nodes at most, or
        one block. `front_node` (2 steps,): node number of the front axle at each half step. At
        least `held_nodes` nodes are held behind it, and `increment_span` behind the rear axle.
        """
        blocks = front_node.size // (2 * steps_per_block)
        node = front_node[: 2 * steps_per_block * blocks].reshape(blocks, -1)
        start, end = node[:, 0], node[:, -1]
        edges = [0]
        while (now := edges[-1]) < blocks:
            far = end[now : now + TUNING.max_blocks] > start[now] + max_advance
            edges.append(now + max(int(np.argmax(np.append(far, True))), 1))
        first = np.array(edges[:-1])
        lowest = np.minimum.reduceat(node.min(axis=1), first)
        high = np.maximum.reduceat(node.max(axis=1), first)
        low, rear_low = (np.floor(lowest - x).astype(int) for x in (0.0, wheelbase_nodes))
        newest = np.maximum.accumulate(np.floor(high).astype(int) + 2)
        rear_newest = np.floor(high - wheelbase_nodes).astype(int) + 2
        rear = np.floor(start[first] - wheelbase_nodes).astype(int) - 1
        initial = int(front_node[0]) + 2
        before = np.append(rear[0], rear[:-1]) - increment_span
        held = np.append(initial, newest[:-1])  # while roughness is updated
        behind = np.minimum(rear_low - 1, low - held_nodes)
        n_nodes = 1 + max(np.max(held - before), np.max(newest - behind))
        return cls(
            edges=np.append(first, blocks),
            newest=newest,
            initial=initial,
            n_nodes=int(n_nodes),
            n_front=newest - low + 2,
            n_rear=rear_newest - rear_low + 2,
            rear_newest=rear_newest,
            rear=rear,
            reached=np.maximum.accumulate(np.append(initial, np.floor(end).astype(int) + 2)),
        )

    @cached_property
    def oldest(self) -> np.ndarray:
        """Oldest node held in each window, and before the first one (W + 1,): `oldest[i]` before
        the window i, `oldest[i + 1]` in it.
        """
        return np.append(self.initial, self.newest) - self.n_nodes + 1

    def last_edge(self, block: np.ndarray) -> np.ndarray:
        """Return the last edge of a window before each `block` (M,); the drive's end is kept."""
        rounded = self.edges[np.searchsorted(self.edges, block, side="right") - 1]
        return np.where(block >= self.edges[-1], self.edges[-1], rounded)
