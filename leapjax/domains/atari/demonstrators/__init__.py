"""Built-in demonstrators of the Atari games: a tool to make data without a download.

They read the emulator's memory. `paddle` plays Pong and Breakout, `qbert` and `seaquest` their
games; `playing` plays a game with one of them, and `collect` writes many games as DQN-Replay.
"""
