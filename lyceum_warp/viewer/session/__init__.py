"""Run the worlds, with torch and Warp."""
