"""A batch of trials: which of some balls does the gripper hold, however they lie?"""

import rtee


def main() -> None:
    trials = [
        rtee.Trial("Grasp", object=f"sphere:{radius}", mass=mass)
        for radius in (0.015, 0.03)
        for mass in (0.1, 0.5)
    ]
    results = rtee.run_trials("robotiq_2f_85", trials, on_result=lambda r: print(r.trial.key))
    held = [result for result in results if result.held]
    print(f"{len(held)} of {len(results)} held")
    for result in results:
        print(result.trial.object, result.trial.mass, "held" if result.held else result.reason)


if __name__ == "__main__":
    main()
