"""Small faults of the core, and the tests that must turn red with each: held to account by test_mutations.py."""

from __future__ import annotations

from typing import NamedTuple

__all__ = ["MUTATIONS", "Mutation"]


class Mutation(NamedTuple):
    """name: what the fault is. file: below og_pointcloud/. old: a text that stands in it exactly once, new: what takes
    its place. tests: node ids below tests/ of which one must fail."""

    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]


def hard(*cases: str) -> tuple[str, ...]:
    """Node ids of hard cases, by "family-name"."""
    return tuple(f"test_hard_cases.py::test_case_holds[{case}]" for case in cases)


def slow(*cases: str) -> tuple[str, ...]:
    """The same of those that are no part of the fast tests."""
    return tuple(f"test_hard_cases.py::test_case_holds_everywhere[{case}]" for case in cases)


def trust(*names: str) -> tuple[str, ...]:
    """Node ids of tests of trust."""
    return tuple(f"test_trust.py::test_{name}" for name in names)


MEMBERSHIP = hard("votes-borders_by_color", "votes-membership_of_any_votes", "votes-certainty_of_any_votes")
SPANNING = (*hard("votes-spanning_masks_of_any_votes"), "test_view_reports.py")
CHOOSING = hard("choosing-nearly_equal_labels", "choosing-label_among_the_bank", "choosing-equal_labels")

MUTATIONS = (
    # Splatting and geometry. Changes of a file with kernels compile it anew: these are few.
    Mutation(
        "near plane at ten times its depth", "rendering/splatting.py",
        "NEAR_SHARE = 0.02", "NEAR_SHARE = 0.2", hard("frames-close_object"),
    ),
    Mutation(
        "low-pass filter twice as wide", "rendering/splatting.py",
        "LOW_PASS = 0.3", "LOW_PASS = 0.6", hard("geometry-scale_zero"),
    ),
    Mutation(
        "near plane from the farthest point", "rendering/geometry.py",
        "np.median(front)) if len(front)", "np.max(front)) if len(front)", ("test_geometry.py",),
    ),
    Mutation(
        "what bends is taken for noise", "rendering/smoothing.py",
        "min(1.0, NOISE_BIAS * noise / variance) * height", "height", ("test_smoothing.py",),
    ),
    Mutation(
        "cells of twice the width", "rendering/pixel_cells.py",
        "CELL_PIXELS * typical", "2 * CELL_PIXELS * typical", ("test_pixel_cells.py",),
    ),
    Mutation(
        "layers of one surface hide each other", "rendering/sightings.py",
        "surface[k] = splats[of_tile[k]].surface", "surface[k] = splats[of_tile[k]].depth", ("test_sightings.py",),
    ),
    Mutation(
        "labels judged by the views that they were made from", "fitting/held_out.py",
        "judge[1 - half]", "judge[half]", ("test_held_out.py",),
    ),
    # Scene, frames.
    Mutation(
        "projection with y upwards", "scene.py",
        "self.fy * y / in_front + self.cy", "self.cy - self.fy * y / in_front", ("test_scene.py",),
    ),
    Mutation(
        "cloud's origin at zero", "scene.py",
        "origin = np.median(world, axis=0)", "origin = np.zeros(3)", hard("frames-offset"),
    ),
    Mutation(
        "pose not moved with the cloud's origin", "formats/poses.py",
        "rigid(rotation, rotation @ origin + translation)", "rigid(rotation, translation)", hard("frames-offset"),
    ),
    Mutation(
        "quaternions of another convention", "formats/poses.py",
        "1 - 2 * (y * y + z * z), 2 * (x * y - w * z)", "1 - 2 * (y * y + z * z), 2 * (x * y + w * z)",
        ("test_colmap.py",),
    ),
    # View votes and membership.
    Mutation(
        "votes by exposure, not its square", "fitting/view_votes.py",
        "OPENNESS_POWER = 2", "OPENNESS_POWER = 1", hard("votes-exposure"),
    ),
    Mutation(
        "what is hardly seen is believed", "fitting/view_reports.py",
        "p_seen, width = used_vote * visibility[g],", "p_seen, width = used_vote,", MEMBERSHIP,
    ),
    Mutation(
        "reports are counted however little a view sees", "fitting/view_reports.py",
        "probability[c] * used_vote * visibility[g] ** 2", "probability[c]", MEMBERSHIP,
    ),
    Mutation(
        "masks that end early stay as they are", "fitting/mask_edges.py",
        "if short <= 0:", "if short <= 9:", ("test_mask_edges.py",),
    ),
    Mutation(
        "masks are widened into others", "fitting/mask_edges.py",
        "(ids == -1) & (away <= self.pixels)", "away <= self.pixels", ("test_mask_edges.py",),
    ),
    Mutation(
        "texture outside of masks widens them", "fitting/mask_edges.py",
        "> MIN_STANDARD_ERRORS * error", "> -1e9", ("test_mask_edges.py",),
    ),
    Mutation(
        "views that look alike add up", "fitting/view_reports.py",
        "max(1.0, total_seen / MAX_INDEPENDENT_VIEWS)", "1.0", MEMBERSHIP,
    ),
    Mutation(
        "background is as likely as any instance", "fitting/view_reports.py",
        "candidates.background, BACKGROUND_LOG_PRIOR, 0.0)", "candidates.background, 0.0, 0.0)", MEMBERSHIP,
    ),
    Mutation(
        "what lies in a mask without a group lies in none", "fitting/view_reports.py",
        "used = max(vote - ungrouped, grouped)", "used = max(vote, grouped)", MEMBERSHIP,
    ),
    Mutation(
        "a mask that spans several things says nothing", "fitting/membership.py",
        "groups.count + np.arange(np.count_nonzero(groups.spanning))", "-1", SPANNING,
    ),
    Mutation(
        "a mask that spans several things speaks of what adjoins alone", "fitting/view_reports.py",
        "if k >= groups else range(0)", "if False else range(0)", SPANNING,
    ),
    Mutation(
        "neighbors are heard however little is seen of them", "fitting/view_reports.py",
        "- MIN_COLOR_RATIO, 0) * visibility[other]", "- MIN_COLOR_RATIO, 0)", MEMBERSHIP,
    ),
    Mutation(
        "neighbors are heard whatever their color", "fitting/view_reports.py",
        "max(weights[g, j] - MIN_COLOR_RATIO, 0)", "(weights[g, j] > 0) * (1 - MIN_COLOR_RATIO)",
        (*hard("votes-borders_by_color"), "test_view_reports.py"),
    ),
    Mutation(
        "neighbors are heard although their color says another thing", "fitting/view_reports.py",
        "max(weights[g, j] - MIN_COLOR_RATIO, 0)", "weights[g, j]", MEMBERSHIP,
    ),
    Mutation(
        "neighbors add up", "fitting/view_reports.py",
        "if total > MAX_INFLUENCE else 0", "if False else 0", hard("votes-certainty_by_color"),
    ),
    Mutation(
        "colors are counted once", "fitting/view_reports.py",
        "color_ratios(rgb, ids, states.probability_of(ids), around)",
        "color_ratios(rgb, candidates.ids, candidates.probability_of(candidates.ids), around)",
        hard("votes-certainty_by_color"),
    ),
    Mutation(
        "a part of a scene counts its own reports", "fitting/view_reports.py",
        "if known is None:", "if True:", ("test_view_reports.py",),
    ),
    Mutation(
        "hidden points taken for seen ones", "fitting/seen_colors.py",
        "likelihood_ratios(*counts)", "likelihood_ratios(*counts[::-1])", ("test_seen_colors.py",),
    ),
    Mutation(
        "pixels are compared as they were exposed", "fitting/seen_colors.py",
        "np.minimum(np.arange(256) / gains[:, None], 255)", "np.arange(256.0) + 0 * gains[:, None]",
        ("test_seen_colors.py",),
    ),
    Mutation(
        "a few points tell the gain of a photograph", "fitting/seen_colors.py",
        "GAIN_PRIOR = 30 * 128.0", "GAIN_PRIOR = 0.0", ("test_seen_colors.py",),
    ),
    Mutation(
        "few colors say as much as many", "fitting/colors.py",
        "first, second = first + prior, second + prior", "first, second = first, second", ("test_seen_colors.py",),
    ),
    Mutation(
        "colors of points whose states are not sure are asked", "fitting/colors.py",
        "probability**SURENESS_POWER", "np.ones_like(probability)", ("test_colors.py",),
    ),
    Mutation(
        "a large group keeps what a smaller one is sure of", "fitting/membership.py",
        "if sure > best[g] and", "if sure < best[g] and", (*MEMBERSHIP, "test_membership.py"),
    ),
    Mutation(
        "seen-through islands stay", "fitting/membership.py",
        "kept[labelled[island]] = UNOBSERVED", "kept[labelled[island]] = 0 * labelled[island]", ("test_membership.py",),
    ),
    Mutation(
        "islands by votes alone stay", "fitting/membership.py",
        "(~majority[part] |", "((part < 0) |", (*MEMBERSHIP, "test_membership.py"),
    ),
    Mutation(
        "noise of one view is an instance", "fitting/membership.py",
        "(rate < settings.rate_share * typical)", "(rate < 0 * typical)", (*MEMBERSHIP, "test_membership.py"),
    ),
    Mutation(
        "what one view alone has a mask of is a thing", "fitting/membership.py",
        "in_doubt & (p_missed < missed_chance *", "in_doubt & (p_missed < 0 *", ("test_membership.py",),
    ),
    Mutation(
        "whatever the colors across its outline", "fitting/membership.py",
        "in_doubt = p_missed < missed_chance * MAX_COLOR_RATIO", "in_doubt = p_missed < missed_chance",
        ("test_membership.py",),
    ),
    Mutation(
        "an outline is all around each point", "fitting/colors.py",
        "if adjoining[g, k] and group[neighbors[g, k]] != group[g]:", "if adjoining[g, k]:", ("test_colors.py",),
    ),
    Mutation(
        "whatever other views mask, one view is alone", "fitting/membership.py",
        "(views == 1) & (per_group(masked - support.votes) < 0.5 * points)", "views == 1", ("test_membership.py",),
    ),
    Mutation(
        "what slips past an edge is grown over", "fitting/membership.py",
        "(support.reweighted_share > settings.possible_openly)", "(support.share > 0)",
        (*MEMBERSHIP, "test_membership.py"),
    ),
    Mutation(
        "one view alone tears a piece off", "fitting/membership.py",
        "sure, sure_votes, sure_possible = -1, swallowed_votes, 0.0", "sure, sure_votes, sure_possible = -1, 0.0, 0.0",
        ("test_membership.py",),
    ),
    Mutation(
        "one vote of many makes a point clear", "fitting/membership.py",
        "(support.votes > settings.sure_votes * support.total)", "(support.votes > 0)",
        (*MEMBERSHIP, "test_membership.py"),
    ),
    Mutation(
        "certainty without the neighbors", "fitting/membership.py",
        "agreement[g] = same / count", "agreement[g] = 1", MEMBERSHIP,
    ),
    Mutation(
        "what an instance lacks is not expected of it", "fitting/view_reports.py",
        "minlength=count) + of_group - right", "minlength=count)", hard("votes-expected_iou_of_any_votes"),
    ),
    # Grouping, association.
    Mutation(
        "groups join without a majority", "fitting/grouping.py",
        ", settings.join_majority)", ", 0.0)", ("test_grouping.py",),
    ),
    Mutation(
        "views that leave out one of two things say nothing", "fitting/grouping.py",
        "settings.left_out_voice * left_out.astype", "0.0 * left_out.astype", ("test_grouping.py",),
    ),
    Mutation(
        "groups as alike as sums of their features", "fitting/grouping.py",
        "np.dot(features[a], features[b]) / pairs if", "np.dot(features[a], features[b]) / np.sqrt(pairs) if",
        ("test_grouping.py",),
    ),
    Mutation(
        "a mask that swallowed a thing tells that it is of its own", "fitting/grouping.py",
        "np.where(self.spanning, -1, self.group)", "self.group", ("test_grouping.py", "test_view_reports.py"),
    ),
    Mutation(
        "points are not asked which masks span things", "fitting/membership.py",
        "if corrected.count == groups.count and (corrected.spanning == groups.spanning).all():", "if True:",
        ("test_view_reports.py",),
    ),
    Mutation(
        "crumbs make masks span", "fitting/grouping.py",
        "held.data > settings.spanning_share * total[mask]", "held.data > 0", ("test_grouping.py",),
    ),
    Mutation(
        "masks that span objects take part", "fitting/grouping.py",
        "usable = ~spanning & (shown > 0)", "usable = shown > 0", ("test_grouping.py",),
    ),
    Mutation(
        "masks compared by what holes leave of them", "fitting/grouping.py",
        "view_votes(table.with_doubted())", "view_votes(table)", ("test_grouping.py",),
    ),
    Mutation(
        "groups numbered by the smallest first", "fitting/grouping.py",
        "np.lexsort((roots, -mass))", "np.lexsort((roots, mass))", ("test_grouping.py",),
    ),
    Mutation(
        "features of any length in a descriptor", "fitting/association.py",
        "return np.divide(wide, length, out=np.zeros_like(wide), where=length > 0)", "return wide",
        hard("features-feature_length", "features-nearly_opposite_rows"),
    ),
    Mutation(
        "outliers stay in a descriptor", "fitting/association.py",
        "kept = cosines >= middle - 3 * max(spread, 1e-6)", "kept = cosines >= -2", ("test_association.py",),
    ),
    Mutation(
        "the mean of all that a thing is called", "fitting/association.py",
        "if first > DOMINANT_WEIGHT_RATIO * second else all_rows", "if first > 9 * second else all_rows",
        ("test_association.py",),
    ),
    Mutation(
        "names of a thing that is not named alike are one kind", "fitting/association.py",
        "SAME_KIND_BOUND = 2 / 3", "SAME_KIND_BOUND = 1 / 2", ("test_association.py",),
    ),
    # Learned modes.
    Mutation(
        "Eq. 5 of masks that share nothing with the union", "fitting/learned/matching.py",
        "+ evidence.mask_area[:, None] - evidence.shared", "+ evidence.mask_area[:, None]", hard("votes-eq5"),
    ),
    Mutation(
        "Eq. 5 of distances past one", "fitting/learned/matching.py",
        "np.maximum(1 - evidence.distance, 0)", "np.abs(1 - evidence.distance)", hard("votes-eq5"),
    ),
    Mutation(
        "Eq. 2 over all pairs, themselves too", "fitting/learned/paper.py",
        "return near.sum() / (m * (m - 1))", "return near.sum() / (m * m)", slow("learning-paper_losses"),
    ),
    # Choosing.
    Mutation(
        "words not centered", "ask/choosing.py",
        "directions = unit_rows(unit_rows(texts) - self.bank.mean)\n        scores",
        "directions = unit_rows(texts)\n        scores", CHOOSING,
    ),
    Mutation(
        "synonyms speak against a label", "ask/choosing.py",
        ".max(axis=1) < self.settings.synonym", ".max(axis=1) < 2", CHOOSING,
    ),
    Mutation(
        "the other words' mean is taken over all", "ask/choosing.py",
        "self._bank_evidence[:, other].astype", "np.where(other, self._bank_evidence, -np.inf).astype", CHOOSING,
    ),
    Mutation(
        "equal labels compete", "ask/choosing.py",
        "hypothesis, first = _distinct(texts)", "hypothesis = first = np.arange(len(texts))", CHOOSING,
    ),
    Mutation(
        "what lies behind a rim shows through a hole", "fitting/holes.py",
        "return np.sqrt(x**2 + y**2) < HALF_PLANE_MEAN_DIRECTION * count", "return count > 0", ("test_holes.py",),
    ),
    Mutation(
        "a kind counts for each of its descriptors", "ask/choosing.py",
        "weight = fits / np.maximum(np.bincount(kind, fits), 1)[kind]", "weight = fits.astype(float)",
        ("test_choosing.py",),
    ),
    # Lookup, scores, files.
    Mutation(
        "nearest point of too few columns", "bundle/nearest.py",
        "for x in (-1, 0, 1) for y in (-1, 0, 1)", "for x in (0, 1) for y in (-1, 0, 1)", ("test_nearest.py",),
    ),
    Mutation(
        "IoU without false positives on background", "evaluate/metrics.py",
        "counted = evaluated if background is None else evaluated | background", "counted = evaluated",
        ("test_metrics.py",),
    ),
    Mutation(
        "arrays longer than their header claims", "formats/npy.py",
        "or claimed != held or", "or claimed > held or", ("test_fuzz.py::test_bytes_behind_an_array",),
    ),
    Mutation(
        "a failed write leaves what it wrote", "formats/atomic.py",
        "temporary.unlink(missing_ok=True)", "temporary.exists() and os.replace(temporary, path)",
        trust("a_disk_that_is_full_while_a_command_writes"),
    ),
    # Strangers' files, and files that are written.
    Mutation(
        "any graph is run", "bundle/known_graph.py",
        "if digest not in KNOWN_GRAPHS:", "if not digest:", trust("no_graph_but_ours_reaches_a_runtime"),
    ),
    Mutation(
        "the number of answer codes is believed", "bundle/read.py",
        'tables["codes"].tolist() == [codes]', "True", trust("no_graph_but_ours_reaches_a_runtime"),
    ),
    Mutation(
        "descriptors of the graph are believed", "bundle/read.py",
        'tables["descriptors"].tobytes() == descriptors.tobytes()', "True",
        trust("a_graph_with_other_descriptors_than_the_file_says"),
    ),
    Mutation(
        "a graph's answers are believed", "ask/query_graph.py",
        "        if len(cloud):", "        if not len(cloud):",
        trust("a_graph_that_contradicts_the_arrays_is_found_out_on_opening"),
    ),
    Mutation(
        "coincident points count as lies", "ask/query_graph.py",
        "if wrong := int((certain & (instances != expected)).sum()):", "if wrong := len(differ):",
        trust("whatever_is_drawn_no_honest_file_is_refused"),
    ),
    Mutation(
        "a manifest of any size", "bundle/format.py",
        "1 << 21, 1 << 23", "1 << 26, 1 << 26", trust("a_manifest_is_bounded_before_it_is_read"),
    ),
    Mutation(
        "lengths of any size are believed", "cloud.py",
        "if not LENGTH_LIMITS[0] <= value <= LENGTH_LIMITS[1]:", "if not value > 0:",
        trust("lengths_whose_squares_are_no_numbers"),
    ),
    Mutation(
        "blank names are words", "bundle/read.py",
        "isinstance(name, str) and name.strip() for", "isinstance(name, str) for", trust("names_that_are_none"),
    ),
    Mutation(
        "what a box cuts off is found in it", "collection/scoring.py",
        "bound[np.searchsorted(rows, self._outside(selected, box))] = -np.inf", "pass",
        ("test_collection.py::test_box_and_scenes_restrict",),
    ),
    Mutation(
        "an atlas that changed is not read again", "collection/collection.py",
        "if stamp and stamp == self._stamp:", "if stamp and self._stamp:",
        ("test_collection.py::test_an_open_collection_notices_a_changed_atlas",),
    ),
    Mutation(
        "pieces of things stay pieces", "fitting/fragments.py",
        "while shares:", "while False:",
        ("test_fragments.py::test_pieces_that_a_table_parts_in_every_view_are_one_thing",),
    ),
    Mutation(
        "a border that tells nothing joins", "fitting/fragments.py",
        "return w, float(np.clip(np.median(share[across]), MIN_SHARE, w))", "return w, MIN_SHARE",
        ("test_fragments.py::test_two_things_stay_two",),
    ),
    Mutation(
        "a piece of two things joins them", "fitting/fragments.py",
        "        looks.join(first, second)\n", "",
        ("test_fragments.py::test_things_are_not_joined_by_a_piece_of_both",),
    ),
    Mutation(
        "many masks are as little alike as few", "fitting/fragments.py",
        "np.sqrt(np.maximum(masks.min(axis=0), 1))", "1.0",
        ("test_fragments.py::test_few_masks_may_differ_more_than_many",),
    ),
    Mutation(
        "ids between ids are believed", "checking/check.py",
        "MAX_BLENDED_SHARE = 0.004", "MAX_BLENDED_SHARE = 2",
        ("test_checking.py::test_pictures_of_ids_that_were_blended_are_told",),
    ),
    Mutation(
        "a search ends where it is hidden from", "checking/registration.py",
        "again = self.best_change(name, small)", "again = small",
        ("test_checking.py::test_a_large_shift_is_taken_back_whole",),
    ),
    Mutation(
        "an encoder of another space answers", "text/encoder.py",
        "if not FeatureSpace(feature_space).accepts(encoder.space):", "if not encoder:",
        trust("a_carried_encoder_of_another_space_answers_nothing"),
    ),
    Mutation(
        "texts may grow", "text/tokenizer.py",
        "if growth > MAX_GROWTH:", "if growth < 0:", trust("tokenizers_that_would_grow_without_end"),
    ),
    Mutation(
        "pieces of any length", "text/tokenizer.py",
        "if longest > MAX_PIECE_CHARACTERS or", "if", trust("tokenizers_that_would_grow_without_end"),
    ),
    Mutation(
        "a plan of memory for every size of frame", "models.py",
        "enable_mem_pattern = False", "enable_mem_pattern = True",
        trust("memory_is_flat_over_frames_of_many_sizes"),
    ),
    Mutation(
        "temporary names by process", "formats/atomic.py",
        "secrets.token_hex(4)", "os.getpid()", trust("threads_that_write_one_path_leave_one_whole_file"),
    ),
    Mutation(
        "temporary files written through links", "formats/atomic.py",
        'temporary.open("xb")', 'temporary.open("wb")',
        trust("temporary_names_cannot_be_guessed_and_links_are_not_followed"),
    ),
    Mutation(
        "files that others write are removed", "formats/atomic.py",
        "                    if _hold(file):", "                    if True:",
        trust("what_killed_runs_left_is_removed_and_what_others_write_is_not"),
    ),
    Mutation(
        "two runs in one folder", "formats/atomic.py",
        "if not _hold(file):", "if not file:", ("test_memory.py::test_only_one_run_at_a_time",),
    ),
    Mutation(
        "foreign text as it is", "errors.py",
        "s if s.isprintable() else repr(s)[1:-1]", "s",
        ("test_fuzz.py::test_messages_are_printable_whatever_the_file_says",),
    ),
    Mutation(
        "results as they are", "cli/__init__.py",
        "map(printable, text.split", "map(str, text.split",
        trust("nothing_in_a_file_reaches_the_terminal_as_it_is"),
    ),
    Mutation(
        "formulas in tables", "formats/tables.py",
        '("=", "+"', '("~", "+"', trust("cells_of_tables_are_no_formulas"),
    ),
    Mutation(
        "images of any size", "formats/images.py",
        "if width * height > MAX_PIXELS:", "if width < 0:", trust("sizes_come_from_headers_and_are_bounded"),
    ),
    Mutation(
        "archives of any ratio", "formats/npy.py",
        "if total > max(ALWAYS_ALLOWED_BYTES, MAX_RATIO * file.stat().st_size):", "if total < 0:",
        trust("a_small_file_does_not_unpack_to_a_large_one"),
    ),
    Mutation(
        "masks through links", "masking/make_masks.py",
        "if link.is_symlink():", "if not link:", trust("nothing_is_written_through_links_of_a_capture"),
    ),
    Mutation(
        "paths in files that travel", "bundle/vocabulary.py",
        'reason = f"{own} has', 'reason = f"{file} has', trust("files_that_travel_hold_no_path"),
    ),
)  # fmt: skip
