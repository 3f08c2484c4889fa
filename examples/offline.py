"""What a hand can do, without running it."""

import rtee

hand = rtee.load_hand("robotiq_2f_85")
print(hand.name, hand.actuator_names, hand.lower, hand.upper)
print("states have", list(hand.observation_features), "streams take", list(hand.action_features))

library = rtee.load_actions(hand)
for action in library:
    print(action.name, *action.elements)
opening = library.openings.of(library.find("Grasp"))
print(f"opens from {opening.narrowest * 1e3:.0f} to {opening.widest * 1e3:.0f} mm")

for plan in rtee.grasp_plan(hand, object="cylinder:0.02x0.1").plans[:3]:
    print(plan.action, *plan.elements, f"{plan.score:.2f}")
