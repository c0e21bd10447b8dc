"""Measures the speed of the environment for agents: agent-steps per second of CPU time, for several numbers of agents.

The game runs in the same process. Each step includes its observations, rewards and infos. Actions are drawn in advance.
The output is the median of five runs, with the range.
"""

import argparse
import time

from server.agents import Arena

ACTIONS = 16
RUNS = 5


def measure(scene: str, agents: int, steps: int) -> list[float]:
    """Returns the agent-steps per second of CPU time of each run, ascending."""
    env = Arena(scene, agents, seconds=1e6)
    env.reset(seed=1)
    for i, agent in enumerate(env.agents):
        env.action_space(agent).seed(i)
    actions = [{agent: env.action_space(agent).sample() for agent in env.agents} for _ in range(ACTIONS)]
    found = []
    for run in range(-1, RUNS):  # run -1 only warms up
        began = time.process_time()
        for i in range(steps):
            env.step(actions[i % ACTIONS])
        if run >= 0:
            found.append(agents * steps / (time.process_time() - began))
    return sorted(found)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--agents", type=int, nargs="+", default=[2, 8, 32, 100], help="default: %(default)s")
    parser.add_argument("--scene", default="hills", help="default: %(default)s")
    parser.add_argument("--steps", type=int, default=300, help="steps per run (default: %(default)s)")
    args = parser.parse_args()
    print("agents   agent-steps per second   x real time")
    for agents in args.agents:
        found = measure(args.scene, agents, args.steps)
        middle = found[len(found) // 2]
        rate = Arena(args.scene, 1).scene.tick_rate
        print(f"{agents:>6}   {middle:>8,.0f} ({found[0]:,.0f} to {found[-1]:,.0f})   {middle / agents / rate:,.0f}")
    return 0
