"""Encoders of BabyAI: grids, poses and instructions of a context become tokens.

`state_tokens` is the paper's encoder, a token for each state of a context; it is built from
`convolutions`. `context_tokens` is ours, a few tokens for the whole context; it is built from
`distances`. Both use `cells` and `instructions`.
"""
