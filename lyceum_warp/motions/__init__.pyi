from lyceum_warp.motions.clips import Clips as Clips, load_clips as load_clips
