"""Choosing a label: against a slow literal reference, invariances, and awkward input."""

from __future__ import annotations

from dataclasses import replace

import literal
import numpy as np
import pytest
from labelled_clouds import instance_table, unit_rows

from og_pointcloud.ask.choosing import Chooser, Reason, common_part
from og_pointcloud.cloud import WordBank
from og_pointcloud.errors import FeatureSpaceError
from og_pointcloud.settings import ChoosingSettings

WIDTH = 64
WORDS = 300


def unit(vectors):
    return (vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)).astype(np.float32)


def encoder_like_clip(count: int, seed: int = 0) -> np.ndarray:
    """(count, 64) texts with a cosine of about 0.74 among themselves."""
    own = unit_rows(count, WIDTH - 1, seed)
    return np.concatenate([np.full((count, 1), np.sqrt(0.74)), np.sqrt(0.26) * own], axis=1).astype(np.float32)


class Made:
    """A scene of instances that show words 0, 1, 2 ... of the texts, seen through the gap between the modes."""

    def __init__(self, instances: int = 6, signal: float = 0.5, owners: list[int] | None = None) -> None:
        self.texts = encoder_like_clip(WORDS + 60)
        self.bank = WordBank(self.texts[60:])
        shared = unit(np.r_[0.3, unit_rows(1, WIDTH - 1, seed=7)[0]])
        noise = unit_rows(instances, WIDTH, seed=8)
        shown = unit(self.texts[:instances] - self.bank.mean)
        table = instance_table(max(owners) + 1 if owners else instances, owners, WIDTH)
        self.table = replace(table, descriptors=unit(0.7 * shared + signal * shown + 0.25 * noise))
        self.chooser = Chooser(self.table, self.bank)


def choose_plainly(made: Made, texts: np.ndarray, bank: WordBank) -> np.ndarray:
    """(K, L) probabilities by the literal form."""
    owner = made.table.descriptor_instance.tolist()
    return literal.choice(made.table.descriptors, owner, texts, bank.vectors, ChoosingSettings())[0]


@pytest.mark.parametrize("labels", [1, 3, 30])
def test_posterior_is_that_of_the_literal_reference(labels):
    made = Made()
    choice = made.chooser.choose(3 * made.texts[:labels])
    plain = choose_plainly(made, made.texts[:labels], made.bank)
    np.testing.assert_allclose(choice.table, plain, atol=2e-4)
    np.testing.assert_allclose(choice.unknown, 1 - plain.sum(axis=1), atol=2e-4)


def test_how_far_fitting_words_stand_out_is_seen_in_the_scene():
    made = Made()
    bank = WordBank(np.concatenate([made.bank.vectors, made.texts[:3]]))
    chooser = Chooser(made.table, bank)
    assert made.chooser.sharpness < chooser.sharpness
    plain = choose_plainly(made, made.texts[3:9], bank)
    np.testing.assert_allclose(chooser.choose(made.texts[3:9]).table, plain, atol=2e-4)


def test_shown_words_are_found_and_absent_ones_are_not():
    made = Made()
    choice = made.chooser.choose(made.texts[:6])
    assert choice.calibrated
    np.testing.assert_array_equal(choice.labels, np.arange(6))
    assert choice.probability.min() > 0.9
    absent = made.chooser.choose(made.texts[10:60])
    assert (absent.labels == -1).mean() > 0.8
    np.testing.assert_array_equal(absent.reasons[absent.labels < 0], Reason.NONE_FITS)
    assert (absent.probability[absent.labels < 0] == 0).all()


def test_a_label_of_an_unseen_word_is_unknown_where_the_words_own_is_not():
    made = Made()
    choice = made.chooser.choose(made.texts[2:3])
    np.testing.assert_array_equal(choice.labels, [-1, -1, 0, -1, -1, -1])


def test_order_of_labels_and_length_of_vectors_do_not_matter():
    made = Made()
    order = np.random.default_rng(0).permutation(12)
    choice = made.chooser.choose(made.texts[:12])
    shuffled = made.chooser.choose(made.texts[:12][order] * np.logspace(-30, 30, 12)[:, None].astype(np.float32))
    np.testing.assert_allclose(shuffled.table, choice.table[:, order], atol=1e-4)
    np.testing.assert_array_equal(np.append(order, -1)[shuffled.labels], choice.labels)


def test_a_duplicate_shares_the_probability_without_halving_it():
    made = Made()
    once = made.chooser.choose(made.texts[:4])
    twice = made.chooser.choose(np.concatenate([made.texts[:4], 2 * made.texts[1:2]]))
    np.testing.assert_allclose(twice.table[:, :4], once.table, atol=1e-6)
    np.testing.assert_allclose(twice.table[:, 4], once.table[:, 1], atol=1e-6)
    np.testing.assert_array_equal(twice.labels, once.labels)  # the first of equals
    np.testing.assert_allclose(twice.unknown, once.unknown, atol=1e-6)


def test_duplicates_of_any_length_are_one_hypothesis():
    made = Made()
    texts = encoder_like_clip(200, seed=5)
    lengths = np.random.default_rng(1).uniform(0.1, 10, (len(texts), 1)).astype(np.float32)
    once, twice = made.chooser.choose(texts), made.chooser.choose(np.concatenate([texts, lengths * texts]))
    np.testing.assert_allclose(twice.table, np.tile(once.table, 2), rtol=1e-3, atol=1e-7)
    np.testing.assert_allclose(twice.table[:, :200].sum(axis=1) + twice.unknown, 1, atol=1e-5)


def test_an_irrelevant_label_barely_moves_the_others():
    made = Made()
    few, more = made.chooser.choose(made.texts[:4]), made.chooser.choose(made.texts[[0, 1, 2, 3, 40]])
    np.testing.assert_allclose(more.table[:, :4], few.table, atol=0.02)


def shared_by(made: Made, descriptors: np.ndarray) -> np.ndarray:
    """What is taken off descriptors where the bank knows all texts but the last 60."""
    directions = unit(made.texts[:-60] - made.texts[:-60].mean(axis=0))
    return common_part(unit(descriptors), directions, ChoosingSettings().sharpness)


def like_the_first(made: Made, count: int) -> np.ndarray:
    """(count, WIDTH) descriptors of one kind, each with noise of its own: cosines of about 0.8."""
    return unit(made.table.descriptors[0] + 0.5 * unit_rows(count, WIDTH, seed=9))


def test_a_kind_counts_once_however_many_are_of_it():
    made = Made()
    whole = shared_by(made, made.table.descriptors)
    np.testing.assert_allclose(whole, 5 / 6 * made.table.descriptors.mean(axis=0), atol=1e-6)
    pieces = np.concatenate([made.table.descriptors, np.repeat(made.table.descriptors[:1], 5, axis=0)])
    np.testing.assert_allclose(shared_by(made, pieces), whole, atol=1e-6)
    many = np.concatenate([like_the_first(made, 40), made.table.descriptors[1:]])
    means = np.concatenate([like_the_first(made, 40).mean(axis=0, keepdims=True), made.table.descriptors[1:]])
    np.testing.assert_allclose(shared_by(made, many), 5 / 6 * means.mean(axis=0), atol=1e-5)


def test_one_kind_alone_keeps_all_that_it_shows():
    np.testing.assert_array_equal(shared_by(Made(), like_the_first(Made(), 4)), np.zeros(WIDTH))


def test_what_no_word_fits_says_nothing_of_what_is_shared():
    made = Made()
    direction = made.texts[-1] - made.texts[:-60].mean(axis=0)  # of a word that the bank lacks
    strange = unit(made.table.descriptors[:1] - made.texts[0] + 0.2 * direction)
    whole = shared_by(made, made.table.descriptors)
    np.testing.assert_array_equal(shared_by(made, np.concatenate([made.table.descriptors, strange])), whole)


def test_a_synonym_in_the_bank_does_not_speak_against_a_label():
    made = Made(instances=6)
    near = unit(made.texts[0] - made.bank.mean)
    synonym = unit(made.bank.mean + 0.5 * (0.7 * near + 0.3 * unit(made.texts[50] - made.bank.mean)))
    bank = WordBank(np.concatenate([made.bank.vectors, np.repeat(made.texts[:1], 8, axis=0)]))
    assert Chooser(made.table, bank).choose(synonym[None]).labels[0] == 0
    deaf = Chooser(made.table, bank, ChoosingSettings(synonym=1.01))
    assert deaf.choose(synonym[None]).table[0, 0] < Chooser(made.table, bank).choose(synonym[None]).table[0, 0]


def test_other_words_that_fit_equally_well_mean_as_much_however_many_pass_for_synonyms():
    made = Made()
    for synonym in (0.01, 0.1, 1.01):
        chooser = Chooser(made.table, made.bank, ChoosingSettings(synonym=synonym))
        chooser._bank_evidence[:] = chooser.sharpness
        choice = chooser.choose(made.texts[:2])
        odds = np.log(max(2, chooser.settings.kinds)) + chooser.sharpness**2 - chooser.sharpness * choice.evidence
        np.testing.assert_allclose(np.log(choice.unknown[:, None] / choice.table), odds, rtol=1e-4)


def test_the_best_of_several_descriptors_counts_for_labels_and_bank_alike():
    made = Made(instances=6, owners=[0, 0, 1, 2, 2, 3])
    choice = made.chooser.choose(made.texts[:6])
    assert choice.labels[0] in (0, 1)
    assert choice.labels[1] == 2
    assert choice.labels[2] in (3, 4)
    # Both things that instance 0 shows are evident, and other words stay at their null.
    assert choice.evidence[0, :2].min() > 3
    assert abs(made.chooser._bank_evidence.mean(axis=1)).max() < 1e-3


def test_points_say_why_they_have_no_label():
    made = Made()
    table = replace(
        made.table, descriptors=made.table.descriptors[:5], descriptor_instance=np.arange(5, dtype=np.int32)
    )
    choice = Chooser(table, made.bank).choose(made.texts[:3])
    labels, probability, reasons = choice.at(np.array([0, 2, 4, 5, -1, -2, -3]))
    np.testing.assert_array_equal(labels, [0, 2, -1, -1, -1, -1, -1])
    assert [Reason(reason).name for reason in reasons] == [
        "LABELLED", "LABELLED", "NONE_FITS", "NOT_DESCRIBED", "IN_NO_MASK", "UNOBSERVED", "TOO_FAR",
    ]  # fmt: skip
    assert (probability[2:] == 0).all()
    views = made.table.views[[0, 2]]
    np.testing.assert_allclose(probability[:2], choice.probability[[0, 2]] * (views + 0.5) / (views + 1), rtol=1e-6)


def test_awkward_vectors():
    made = Made()
    zero = np.zeros((1, WIDTH), np.float32)
    choice = made.chooser.choose(np.concatenate([zero, made.texts[:6], made.bank.mean[None]]))
    np.testing.assert_array_equal(choice.labels, np.arange(1, 7))
    assert (choice.table[:, 0] == 0).all()
    assert (choice.table[:, 7] < 0.05).all()
    assert (made.chooser.choose(zero).labels == -1).all()
    half = made.chooser.choose(made.texts[:6].astype(np.float16))
    np.testing.assert_allclose(half.table, made.chooser.choose(made.texts[:6]).table, atol=0.01)
    alike = made.chooser.choose(np.repeat(made.texts[:1], 5, axis=0))
    np.testing.assert_array_equal(alike.labels, [0, -1, -1, -1, -1, -1])


def test_equal_and_zero_descriptors_give_no_warning_and_no_label_by_chance():
    made = Made()
    same = replace(made.table, descriptors=np.repeat(made.table.descriptors[:1], 6, axis=0))
    assert len(np.unique(Chooser(same, made.bank).choose(made.texts[:6]).labels)) == 1
    nothing = replace(made.table, descriptors=np.zeros((6, WIDTH), np.float32))
    assert (Chooser(nothing, made.bank).choose(made.texts[:6]).labels == -1).all()


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_numbers_that_are_none_give_one_error(bad):
    made = Made()
    texts = made.texts[:3].copy()
    texts[1, 5] = bad
    with pytest.raises(FeatureSpaceError, match=r"row 1 of the label vectors contains NaN or infinity"):
        made.chooser.choose(texts)


def test_widths_must_agree():
    made = Made()
    with pytest.raises(FeatureSpaceError, match=r"label vectors are in .*\(dimension 3\); expected .*\(dimension 64\)"):
        made.chooser.choose(np.ones((2, 3)))
    with pytest.raises(FeatureSpaceError, match=r"bank.s vectors are in .*\(dimension 16\)"):
        Chooser(made.table, WordBank(unit_rows(60, 16)))
    with pytest.raises(FeatureSpaceError, match=r"shape \(64,\); expected \(count, dimension\)"):
        made.chooser.choose(made.texts[0])
    with pytest.raises(FeatureSpaceError, match=r"a word bank of 49 words; expected at least 50"):
        WordBank(unit_rows(49))


def test_nothing_to_choose_from():
    made = Made()
    empty = made.chooser.choose(np.zeros((0, WIDTH)))
    assert empty.table.shape == (6, 0)
    assert (empty.labels == -1).all()
    bare = Chooser(instance_table(3, []), made.bank).choose(made.texts[:2])
    np.testing.assert_array_equal(bare.reasons, [Reason.NOT_DESCRIBED] * 3)
    np.testing.assert_array_equal(bare.unknown, [1, 1, 1])


def test_without_a_bank_the_largest_cosine_is_called_and_no_probability_claimed():
    made = Made()
    choice = Chooser(made.table).choose(made.texts[:6])
    cosines = made.table.descriptors @ made.texts[:6].T
    assert not choice.calibrated
    np.testing.assert_array_equal(choice.labels, cosines.argmax(axis=1))
    assert np.isnan(choice.probability).all()
    assert np.isnan(choice.unknown).all()
    opposite = np.stack([np.zeros(WIDTH), -made.table.descriptors[0]])
    assert Chooser(made.table).choose(opposite).labels[0] == 1, "a zero row fits nothing"


def test_templates_narrow_what_prompts_scatter():
    """Each prompt moves a text at random; the mean over prompts finds more words than a single prompt does."""
    made = Made(instances=40, signal=0.25)
    random = np.random.default_rng(0)
    prompts = made.texts[:40, None] + 0.09 * random.normal(size=(40, 6, WIDTH))
    single = made.chooser.choose(prompts[:, 0])
    mean = made.chooser.choose(unit(prompts).mean(axis=1))
    right = [int((choice.labels == np.arange(40)).sum()) for choice in (single, mean)]
    assert right[1] > right[0]


def test_settings_refuse_nonsense():
    with pytest.raises(ValueError, match="sharpness is 0; expected a finite number above 0, by default"):
        ChoosingSettings(sharpness=0)


def test_a_ranking_tells_saturated_probabilities_apart():
    made = Made()
    choice = made.chooser.choose(made.texts[:2])
    table = np.array([[1, 0], [1, 0], [0.3, 0.6], [1, 0], [0, 0], [0, 0]], np.float32)
    evidence = np.array([[5, 1], [9, 1], [12, 13], [9, 0], [-2, 3], [-1, 2]], np.float32)
    choice = replace(choice, table=table, evidence=evidence)
    assert choice.ranking(0).tolist() == [1, 3, 0, 2, 5, 4]
    assert choice.words(4, ("a", "b")) == [("b", 0.0), ("a", 0.0)]
    assert choice.words(2, ("a", "b"), 1) == [("b", pytest.approx(0.6))]
