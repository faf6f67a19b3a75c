"""Built-in demonstrators of the Atari games, which make data without a download.

They read the emulator's memory. `paddle` plays Pong and Breakout, `qbert` plays Qbert, and
`seaquest` plays Seaquest. The module `playing` plays a game with its demonstrator, and `collect`
writes many games in the format of DQN-Replay.
"""
