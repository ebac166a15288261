"""Store the policies of runs in the package: lyceum-warp bench store_pretrained RUN...

The folder lyceum_warp/pretrained/TASK then contains the run's settings, the policy with its network weights in float16,
and the policy's return in exact physics on the C engine.
"""

import argparse
import json
from pathlib import Path

import torch

import lyceum_warp as lw
from lyceum_warp.algos import ENDLESS_STEPS, evaluate
from lyceum_warp.binding import file_name
from lyceum_warp.cli.evaluate import run_worlds
from lyceum_warp.training import Run, read_checkpoint
from lyceum_warp.training.runs.checkpoints import write_content

FOLDER = Path(lw.__file__).parent / "pretrained"
KEPT = ("format", "algorithm", "task", "params", "physics", "exact_from", "options", "nworld", "threads", "seed")
EPISODES, SEED = 32, 1
FEW, FIRST = 4, 60  # a stored policy is tested in this many worlds and steps


def store(folder: Path, which: str) -> Path:
    run = Run.open(folder)
    algorithm = run.config["algorithm"]
    out = FOLDER / file_name(run.task_name)
    content = read_checkpoint(run.policy_file(which), parts=("iteration", "policy"))
    saved = content["policy"]
    state = {name: part.half() if name.startswith("network.") else part for name, part in saved["state"].items()}
    saved_task = {name: value for name, value in run.config["kept"].items() if name in ("name", "model_hash")}
    config = {name: run.config.get(name) for name in KEPT} | {
        algorithm: run.config[algorithm], "engine": "auto", "device": "cpu", "kept": saved_task,
        "versions": {"mujoco": run.config["versions"]["mujoco"]},
    }  # fmt: skip
    out.mkdir(parents=True, exist_ok=True)
    write_content(
        out / "policy.pt",
        {"lyceum_warp": content["lyceum_warp"], "iteration": content["iteration"], "policy": saved | {"state": state}},
    )
    (out / "config.json").write_text(json.dumps(config, indent=1))
    stored = Run.open(out)
    env = run_worlds(stored, {"physics": "exact"}, {}, nworld=EPISODES)
    if env.horizon == 0:
        env = env.replicate(horizon=ENDLESS_STEPS)
    policy = lw.load(stored)
    returns = evaluate(env, policy, EPISODES, seed=SEED).returns
    few = run_worlds(stored, {"physics": "exact"}, {}, nworld=FEW)
    few.rand_reset(SEED)
    total = torch.zeros(FEW)
    for _ in range(FIRST):
        few.action.copy_(policy.act(few.obs))
        few.step()
        total += few.reward
    evaluated = {
        "return": round(returns.mean().item(), 4), "std": round(returns.std(correction=0).item(), 4),
        "episodes": EPISODES, "seed": SEED, "lyceum_warp": lw.__version__,
        "first_steps": {"steps": FIRST, "worlds": FEW, "return": round(total.mean().item(), 4)},
    }  # fmt: skip
    stored.amend(evaluated=evaluated)
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN")
    parser.add_argument("--which", default="last", help="last or best")
    options = parser.parse_args()
    torch.set_num_threads(1)
    for folder in options.runs:
        out = store(folder, options.which)
        size = sum(path.stat().st_size for path in out.iterdir())
        print(f"{out}: {size / 1e3:.0f} kB, {json.loads((out / 'config.json').read_text())['evaluated']}")


if __name__ == "__main__":
    main()
