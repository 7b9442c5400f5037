"""Tools for tests of programs that hold leases: a private daemon, a simulated GPU, consumers, and
assertions on what happened. `plugin` is their pytest plugin; no other module imports pytest.

    def test_the_policy_makes_room(arbiter, consumer, timeline):
        policy = consumer("policy", hold, "policy", "4GiB")
        policy.reached("held")
        consumer("detector", [sys.executable, "-m", "robot.detector"]).reached("held")
        timeline.evicted_once("policy")
        timeline.no_overcommit()

This file imports nothing: pytest loads it at each start.
"""
