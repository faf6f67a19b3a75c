"""DQN-Replay: reads whole trajectories from the replay buffers that Dopamine's DQNs stored.

Five DQNs, with seeds 1 to 5, learned each game. The games of a DQN are a folder of shards (50
shards of R = 1,000,000 rows in Agarwal et al., 2020). Shard N has six files, each the gzip of a
`.npy`:

    $store$_observation_ckpt.N.gz  [R, 84, 84] uint8: the frame before each action
    $store$_action_ckpt.N.gz       [R] int32
    $store$_reward_ckpt.N.gz       [R] float32, clipped to [-1, 1]
    $store$_terminal_ckpt.N.gz     [R] uint8: 1 if the episode ended with this action
    add_count_ckpt.N.gz            state of the buffer, not read here
    invalid_range_ckpt.N.gz        state of the buffer, not read here

Three rows of zeros, the padding, come before every episode. The last row does not belong to its
shard: the buffer is circular, and had not overwritten that row yet. An episode may continue in the
next shard; then neither shard holds the whole episode.

The module `shards` names the files, and `arrays` unpacks them. Then `trajectories` samples whole
trajectories, and `conversion` stores their frames for memory-mapping. All these steps are joined
in `reading`. New shards are written by `writing`.
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
