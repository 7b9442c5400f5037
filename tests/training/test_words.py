"""Words that the models learn: queries with what they match, questions with true answers."""

import random

from training import queries, questions
from training.scene_vlm import balanced
from training.tokens import learn_merges


def test_a_query_matches_what_it_names_and_nothing_else() -> None:
    red_cube = queries.Query("the red cube", "red", "cube")
    assert red_cube.matches("red cube")
    assert not red_cube.matches("red ball")
    assert not red_cube.matches("blue cube")
    assert queries.Query("red thing", "red", None).matches("red ball")
    assert not queries.Query("a mug", None, None, known=False).matches("red cube")


def test_sampled_queries_cover_the_vocabulary_and_strangers() -> None:
    asked = queries.sample_queries(random.Random(1), ["red", "blue"], ["cube", "ball"], 5)
    assert {(q.color, q.shape) for q in asked if q.known} == {
        ("red", "cube"), ("red", "ball"), ("blue", "cube"), ("blue", "ball"),
        ("red", None), ("blue", None), (None, "cube"), (None, "ball"),
    }  # fmt: skip
    assert sum(not q.known for q in asked) == 5


def test_answers_are_true_and_begin_with_yes_or_no() -> None:
    rng = random.Random(1)
    held = {
        "red cube": "Yes, the gripper holds the red cube.",
        "red ball": "No, the gripper holds the red ball.",
        None: "No, the gripper is empty.",
    }
    for name, answer in held.items():
        assert questions.grasped(rng, "red cube", name)[1] == answer
    assert questions.listing(rng, ["orange ball", "red cube"])[1] == "An orange ball, a red cube."
    assert questions.listing(rng, [])[1] == "No objects."
    for _ in range(40):
        question, answer = questions.holding(rng, None)
        assert answer.startswith("Yes") == (question in questions.EMPTY)
    names = ["red cube", "red ball", "blue ball"]
    assert questions.alike("red cube", names) == ["red ball"]
    assert questions.alike(None, names) == []


def test_balanced_repeats_the_rarer_kind() -> None:
    assert balanced([1], [2, 3, 4]) == [1, 2, 1, 3, 1, 4]
    assert balanced([], [2, 3]) == [2, 3]


def test_merges_make_each_word_one_token() -> None:
    tokens, merges = learn_merges(["red", "reds", "cube"], suffix="")
    assert {"red", "reds", "cube"} <= set(tokens)
    assert merges == learn_merges(["cube", "reds", "red"], suffix="")[1]
