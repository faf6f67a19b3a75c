"""DQN-Replay: games as Dopamine's replay buffer kept them, read as whole trajectories.

Five DQNs, of seeds 1 to 5, learned each game. The games of one are a folder of shards; shard N is
six files, each a gzip of one `.npy` (Agarwal et al., 2020: 50 shards of 1,000,000 rows R):

    $store$_observation_ckpt.N.gz  [R, 84, 84] uint8: the frame before each action
    $store$_action_ckpt.N.gz       [R] int32
    $store$_reward_ckpt.N.gz       [R] float32, clipped to [-1, 1]
    $store$_terminal_ckpt.N.gz     [R] uint8: the episode ended with this action
    add_count_ckpt.N.gz, invalid_range_ckpt.N.gz: the buffer's own, not read here

Three rows of zeros, the padding, come before every episode. The last row is not of this shard:
the buffer is circular, and had not overwritten that row yet. An episode may go on from one shard
to the next; then neither holds the whole of it.

`shards` names the files, `arrays` unpacks them, `trajectories` samples whole ones, `conversion`
keeps their frames ready, `reading` joins these steps, and `writing` makes shards.
"""

from leapjax.domains.atari.replay.reading import read
from leapjax.domains.atari.replay.shards import Episode, has_shard, replay_logs
from leapjax.domains.atari.replay.trajectories import CUT_AFTER, CUT_BEFORE
from leapjax.domains.atari.replay.writing import write_shard

__all__ = [
    "CUT_AFTER",
    "CUT_BEFORE",
    "Episode",
    "has_shard",
    "read",
    "replay_logs",
    "write_shard",
]
