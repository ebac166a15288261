"""The session, in this process: torch, Warp and the worlds."""
