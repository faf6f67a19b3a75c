"""Encoders of BabyAI: grids, poses and instructions of a context become tokens.

The paper's encoder, `state_tokens`, makes a token for each state of a context and uses
`convolutions`. Our encoder, `context_tokens`, makes a few tokens for the whole context and uses
`distances`. Both use `cells` and `instructions`.
"""
