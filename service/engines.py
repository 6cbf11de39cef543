"""Models in memory: the default from the start, others when somebody asks for them, never more than a few."""

from __future__ import annotations

import threading
from collections import OrderedDict
from pathlib import Path

from pointfilter.engine import Engine, available_cpus
from pointfilter.errors import ModelNotFoundError
from pointfilter.models import ModelBundle, available_models, load_bundle
from service.settings import Settings


class Engines:
    """Bundles and engines by name. Its methods read files and may take a while: call them off the event loop."""

    def __init__(self, settings: Settings) -> None:
        self.default = settings.model
        self._folders: list[Path] = [settings.model_dir] if settings.model_dir else []
        self._device = settings.device
        self._threads = settings.threads or max(1, available_cpus() // settings.workers)
        self._capacity = settings.max_models
        self._bundles: dict[str, ModelBundle] = {}
        self._loaded: OrderedDict[str, Engine] = OrderedDict()
        self._lock = threading.Lock()

    def names(self) -> list[str]:
        """Names of the models at hand, the default first."""
        return sorted(available_models(self._folders), key=lambda name: (name != self.default, name))

    def bundle(self, name: str) -> ModelBundle:
        """A bundle, checked against its sha256 once. Raises ModelNotFoundError, InvalidModelError."""
        with self._lock:
            return self._bundle(name)

    def engine(self, name: str) -> Engine:
        """An engine that has answered a test patch.

        Raises ModelNotFoundError, InvalidModelError, ProviderUnavailableError.
        """
        with self._lock:
            if name not in self._loaded:
                self._bundles.pop(name, None)  # the folder may hold a newer export by now
                engine = Engine(self._bundle(name), self._device, self._threads)
                engine.warm_up()
                self._loaded[name] = engine
                if len(self._loaded) > self._capacity:
                    # Requests that still use the engine hold it; it goes when the last of them is done.
                    del self._loaded[next(other for other in self._loaded if other not in (self.default, name))]
            self._loaded.move_to_end(name)
            return self._loaded[name]

    def loaded(self) -> list[Engine]:
        """The engines in memory."""
        with self._lock:
            return list(self._loaded.values())

    def _bundle(self, name: str) -> ModelBundle:
        if name not in self._bundles:
            models = available_models(self._folders)
            if name not in models:
                raise ModelNotFoundError("there is no model of this name", hint=f"known: {', '.join(models) or 'none'}")
            self._bundles[name] = load_bundle(models[name])
        return self._bundles[name]
