"""The session: this process, with torch, Warp and the worlds."""
