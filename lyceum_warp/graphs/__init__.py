"""Host code around Warp launches: capture and replay, rehearsal, compilation ahead of time."""
