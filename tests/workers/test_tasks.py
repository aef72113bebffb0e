"""The threads of a worker that compare a job's known results."""

import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from fluoromap_service.jobs.turns import ReadyStage
from fluoromap_workers.tasks import Comparisons

THREADS = 4


class Place:
    def __init__(self):
        self.finished = []

    def finish_known(self, job_id):
        self.finished.append(job_id)


def test_one_thread_compares_a_kind_of_stage_and_the_others_wait_for_it():
    place, comparisons = Place(), Comparisons()
    together = threading.Barrier(THREADS)
    done_before = []

    def compare(number):
        together.wait()
        own = comparisons.compare(ReadyStage(number, "job", "segment"), place)
        done_before.append(list(place.finished))
        return own

    with ThreadPoolExecutor(THREADS) as threads:
        assert sorted(threads.map(compare, range(THREADS))) == [False] * (THREADS - 1) + [True]
    assert done_before == [["job"]] * THREADS


def test_each_job_and_each_kind_is_compared():
    place, comparisons = Place(), Comparisons()
    kinds = [("one", "segment"), ("one", "monoplane"), ("two", "segment")]
    for job, name in kinds * 2:
        comparisons.compare(ReadyStage(1, job, name), place)
    assert place.finished == ["one", "one", "two"]


def test_a_comparison_that_failed_is_tried_again():
    class Broken(Place):
        def finish_known(self, job_id):
            raise OSError

    place, comparisons = Place(), Comparisons()
    with pytest.raises(OSError):
        comparisons.compare(ReadyStage(1, "job", "segment"), Broken())
    assert comparisons.compare(ReadyStage(1, "job", "segment"), place)
    assert place.finished == ["job"]


def test_only_the_latest_kinds_are_remembered():
    place, comparisons = Place(), Comparisons()
    for number in range(200):
        comparisons.compare(ReadyStage(1, f"job {number}", "segment"), place)
    assert not comparisons.compare(ReadyStage(1, "job 199", "segment"), place)
    assert comparisons.compare(ReadyStage(1, "job 0", "segment"), place)
