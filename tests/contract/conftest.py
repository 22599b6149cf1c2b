"""The order of the contract tests: those of one scene, and there of one effect, follow each other, so that a scene is
loaded once and is the only one alive."""


def pytest_collection_modifyitems(items):
    places = [n for n, item in enumerate(items) if hasattr(item.module, "bench_asked")]

    def scene(item):
        values = item.callspec.params if hasattr(item, "callspec") else {}
        return item.module.bench_asked(item.fixturenames, values)

    for place, item in zip(places, sorted((items[n] for n in places), key=scene)):  # stable: otherwise as written
        items[place] = item
