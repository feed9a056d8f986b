"""The forward chain with its latent amplitude: predictions of all stations of a dataset, in order of time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rim_camera_ros.camera import Camera
from rim_camera_ros.chain import Chain
from rim_camera_ros.effects import effects_of
from rim_camera_ros.effects.light_curves import LightCurves
from rim_camera_ros.effects.signal import Signal
from rim_camera_ros.fit.amplitudes import AmplitudeModel, gains_and_error
from rim_camera_ros.fit.correlated_errors import correlated_columns, half_waves_of
from rim_camera_ros.fit.data import Dataset, Station
from rim_camera_ros.fit.light import Light, LightPath
from rim_camera_ros.fit.pose_columns import PoseColumn
from rim_camera_ros.fit.prediction import Prediction
from rim_camera_ros.fit.views import NEAR, Margins, View, Views
from rim_camera_ros.fit.windows import light_within, on_whole_array, view_within, window_of
from rim_camera_ros.frame import Settings
from rim_camera_ros.noise import ROUNDING, rounding_of_mean, sigma_amplitude
from rim_camera_ros.phasor import wrap_residual
from rim_camera_ros.scene import Scene

if TYPE_CHECKING:
    from rim_camera_ros.fit.shifts import Shift

Array = NDArray[Any]

#: Sigmas of one frame by which the pixels used are brighter than the amplitude below which nothing is
#: measured: noise takes next to none of their frames below it.
_ABOVE_THRESHOLD = 3.0
#: Relative step of a difference quotient over the amplitude; its error is of the same size.
_SMALL = 1e-4


class Forward:
    """Predictions of a dataset's stations by one camera, in order of time.

    ``masks`` of each station and channel, where given, restrict the pixels that are used, so that fits by
    different cameras can be compared. ``shifts`` of each station are the differences of another recording
    from this forward model's predictions, with the variances of its noise. ``variance_factors`` by recording
    and placement multiply the variances of a pose's distances. ``light_curves`` change the light in addition
    to the camera file's effects.
    ``camera_of_noise`` is the camera whose response is used where noise is evaluated (None: ``camera``).
    ``linear`` blocks of regressors are nuisances whose values `residuals.after_nuisances` subtracts.
    ``patches`` (H, W) of each recording and placement are how many pixels share the error of a pixel's
    predicted amplitude, as `Views.alike`; None: by this geometry. Geometries whose likelihoods are compared
    need the same.
    ``correlated_error`` [m] is the 1-sigma of errors that neighbours share, independent by pose (0: none).
    ``margins`` allow pixels nearer to edges, where no masks are given.
    ``tick`` is called for each station and may raise to end the work; ``threads`` may share the work on
    predictions.
    """

    def __init__(self, dataset: Dataset, scene: Scene, camera: Camera, *, views: Views | None = None) -> None:
        self.dataset, self.scene, self.camera = dataset, scene, camera
        fits = views is not None and views.fits(camera, scene)
        self.views = views if views and fits else Views(camera, scene, decimation=dataset.decimation)
        self.notes: set[str] = set()
        self.amplitude_model = AmplitudeModel()
        self.masks: Sequence[tuple[Array, Array]] | None = None
        self.patches: Mapping[tuple[int, int], Array] | None = None
        self.shifts: Sequence[Shift] | None = None
        self.margins: Margins | None = None
        self.variance_factors: Mapping[tuple[int, int], float] = {}
        self.light_curves: LightCurves | None = None
        self.linear: Sequence[Any] = ()
        self.camera_of_noise: Camera | None = None
        self.correlated_error = 0.0
        self.tick: Callable[[], None] | None = None
        self.threads = 1
        self._chain = Chain.of(camera.effects.values(), of_means=True)
        self._order = {name: i for i, name in enumerate(effects_of(camera))}
        self._path = LightPath(camera, scene, self._chain)
        # terms that act on neighbours, and scenes that move while a frame is taken, need the whole array
        others = [effect for effect in camera.effects.values() if effect not in self._chain.light]
        self._windows = all(effect.pointwise for effect in others) and not scene.camera_motion.moves

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"views": None, "tick": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self.views = Views(self.camera, self.scene, decimation=self.dataset.decimation)

    def estimate_amplitudes(self, gains: Mapping[tuple[int, int], float] | None = None) -> AmplitudeModel:
        """Estimate the gain of every pose and the relative error of predicted amplitudes (robustly).

        Known ``gains`` are kept. Without variation from pose to pose (``radiometry.gain_sigma`` 0) there
        is one gain for all.
        """
        pixels = self.amplitude_model.pixels
        predictions = self.predictions(AmplitudeModel(tau=0.0, pixels=pixels), slopes=False)
        varies = self.camera.radiometry.gain_sigma > 0
        found, tau = gains_and_error(predictions, self._expanded, gains=gains, varies=varies)
        self.amplitude_model = AmplitudeModel(found, tau, pixels)
        return self.amplitude_model

    def predictions(
        self, model: AmplitudeModel | None = None, *, slopes: bool = True, every: int = 1
    ) -> Iterator[Prediction]:
        """Yield the prediction of every ``every``-th station, in order."""
        model = self.amplitude_model if model is None else model
        memory: dict[str, Any] = {}
        recording = None
        for number, station in enumerate(self.dataset.stations):
            if number % every:
                continue
            if station.recording != recording:
                memory, recording = {}, station.recording
            if self.tick is not None:
                self.tick()
            predicted = self._predict(station, memory, model, slopes)
            if self.shifts is not None:
                self.shifts[number].apply(predicted)
                predicted.used &= np.isfinite(predicted.residual)
                predicted.amplitude_used &= predicted.used
            factor = self.variance_factors.get((station.recording, station.placed), 1.0)
            if factor != 1.0:
                predicted.sigma = predicted.sigma * np.sqrt(factor)
            if self.masks is not None:
                # the same pixels for all cameras, otherwise likelihoods could not be compared
                possible = (
                    np.isfinite(predicted.residual)
                    & np.isfinite(predicted.sigma)
                    & (predicted.station.count > 0)
                )
                predicted.used = self.masks[number][0] & possible
                predicted.amplitude_used = self.masks[number][1] & possible
            yield predicted

    def pixels_used(self) -> list[tuple[Array, Array]]:
        """Return the pixels of each station that are used, for both channels, (H, W) each."""
        return [(prediction.used, prediction.amplitude_used) for prediction in self.predictions(slopes=False)]

    def patches_seen(self) -> dict[tuple[int, int], Array]:
        """Return how many pixels share an error of the predicted amplitude, as ``patches``."""
        return {
            (station.recording, station.placed): self.views.alike(self.views.view(station)).astype(np.int32)
            for station in self.dataset.stations
        }

    def pixels_near_edges(self, margins: Margins = NEAR) -> list[tuple[Array, Array]]:
        """Return the pixels that are used with those beside edges included, as `pixels_used`."""
        masks, self.masks, self.margins = self.masks, None, margins
        try:
            return self.pixels_used()
        finally:
            self.masks, self.margins = masks, None

    def _expanded(self, published: Array) -> Array:
        effect = self._chain.response
        if effect is None:
            return published
        if self.light_curves is not None and self.light_curves.responds:
            return self.light_curves.light_of(published, effect.compressed)
        return np.asarray(effect.expanded(published))

    def _predict(
        self, station: Station, memory: dict[str, Any], model: AmplitudeModel, slopes: bool
    ) -> Prediction:
        camera, margin = self.camera, self._path.margin
        measured, window = self.dataset.measured[station.recording, station.placed], None
        view = self.views.view(station, measured)
        if self._windows and margin is not None:
            window = window_of(view, measured, margin=margin)
        gain = model.gains.get((station.recording, station.pose), 1.0)
        light = self._path.delivered(
            station,
            view,
            power=camera.radiometry.gain * camera.integration_time(station.settings) * gain,
            views=self.views,
            curves=self.light_curves,
            measured=self._noise_amplitude,
            memory=memory,
            notes=self.notes,
        )
        if window is None:
            return self._compare(station, view, light, model, slopes, gain)
        within = view_within(view, window)
        own = light_within(light, within, window)
        inner = self._compare(station.part(*window), within, own, model, slopes, gain)
        return on_whole_array(inner, station, view, light)

    def _compare(
        self,
        station: Station,
        view: View,
        from_scene: Light,
        model: AmplitudeModel,
        slopes: bool,
        gain: float,
    ) -> Prediction:
        camera, context = self.camera, from_scene.context
        light, nameless = from_scene.delivered, from_scene.nameless
        pixel_gain: Array | float = 1.0
        if model.pixels is not None:
            pixel_gain = np.where(nameless, 1.0, np.exp(context.inside(model.pixels)))
        nameless = nameless if station.unlike is None else nameless | station.unlike
        n = np.maximum(station.count, 1)
        lit = light.amplitude > 0
        # gains multiply readings, after the response: otherwise its power would change all of them
        before_response = np.where(lit, light.amplitude, 1.0)
        safe = before_response * pixel_gain
        latent, follows, by_measured = self._latent(station, safe, n, model, pixel_gain)
        measured = self._noise_amplitude(station, latent)
        latent = np.where(nameless, measured, latent)
        delivered = Signal(light.distance, np.where(lit, latent, 0.0))
        terms = self._chain.evaluated(delivered.distance, latent, context, slopes=slopes)
        distance = delivered.distance + terms.total
        residual = station.distance - distance
        if camera.sensor.wraps:
            residual = wrap_residual(residual, context.ambiguity)
        response, model_reading = self._chain.response, self._chain.published(before_response)
        slope_published: Any = 1.0 if response is None else response.slope(latent / pixel_gain)
        model_slope: Any = before_response * (1.0 if response is None else response.slope(before_response))
        if response is not None and self.light_curves is not None:
            free = self.light_curves.response(before_response)
            model_reading, model_slope = model_reading * free, model_slope * free
            slope_published = slope_published * self.light_curves.response(latent / pixel_gain)
        model_reading = model_reading * pixel_gain
        variance, amplitude_variance = self._variances(measured, light.distance, station.settings)
        variance = (variance + camera.sensor.lsb**2 / 12) / n
        by_noise = amplitude_variance * slope_published**2
        noise_variance = by_noise / n + rounding_of_mean(by_noise, n)
        # neighbours share the error of a prediction: their mean is no better than one of them
        model_variance = (model.tau * model_reading) ** 2
        alike = (self.patches or {}).get((station.recording, station.placed))
        if alike is None or alike.shape != camera.shape:
            alike = self.views.alike(view)
        elif view.window is not None:
            alike = alike[view.window]
        amplitude_variance = noise_variance + model_variance * alike
        clean = view.clean if self.margins is None else self.views.clean(view, self.margins)
        used = clean & lit & (station.count > 0) & (station.saturated == 0)
        used &= np.isfinite(residual) & np.isfinite(variance) & (station.count * 2 > station.frames)
        threshold = max(camera.sensor.amplitude_threshold, camera.minimum_amplitude or 0.0)
        # nearer to the threshold, frames that noise took below it are missing, and the others are too bright
        used &= np.minimum(safe, latent) > threshold + _ABOVE_THRESHOLD * np.sqrt(by_noise + ROUNDING)
        amplitude_used = used & (station.count == station.frames)
        amplitude_used &= ~(nameless | self._path.is_undescribed(view.geometry))
        return Prediction(
            station=station,
            view=view,
            context=context,
            order=self._order,
            before=from_scene.before,
            delivered=delivered,
            distance=distance,
            amplitude=latent,
            residual=residual,
            amplitude_residual=station.amplitude - model_reading,
            sigma=np.sqrt(variance),
            amplitude_sigma=np.sqrt(amplitude_variance),
            amplitude_noise=np.sqrt(noise_variance),
            amplitude_share=1.0 / alike,
            amplitude_freedom=noise_variance / amplitude_variance,
            used=used,
            amplitude_used=amplitude_used,
            slope_distance=1.0 + terms.by_distance,
            slope_amplitude=terms.by_amplitude,
            slope_published=np.broadcast_to(slope_published, safe.shape),
            pose_columns=self._pose_columns(view, station),
            model_amplitude=safe,
            model_reading=model_reading,
            model_slope=np.where(lit, model_slope * pixel_gain, 0.0),
            gain=gain,
            pixel_gain=pixel_gain,
            amplitude_follows=np.where(nameless, 0.0, follows),
            amplitude_measured=np.where(nameless, 1.0, by_measured),
            spread=[effect for effect in self._chain.light if effect.spreads],
            spread_light=from_scene.spread,
            undescribed=from_scene.undescribed,
            light_curves=self.light_curves,
            linear=self.linear,
        )

    def _pose_columns(self, view: View, station: Station) -> list[PoseColumn]:
        if not self.correlated_error:
            return view.pose_columns
        measured = self.dataset.measured[station.recording, station.placed]
        half_waves = half_waves_of(self.dataset.poses)
        waves = correlated_columns(view, self.correlated_error, measured=measured, half_waves=half_waves)
        return [*view.pose_columns, *waves]

    def _noise_amplitude(self, station: Station, predicted: Array) -> Array:
        """Return the light [counts] at which noise is evaluated: the measured one, not the predicted one.

        Cameras that are compared must have the same noise, otherwise a change of light gains by the noise.
        """
        light = np.asarray((self.camera_of_noise or self.camera).light_of(station.amplitude.astype(float)))
        return np.where(np.isfinite(light) & (light > 0), light, predicted)

    def _variances(self, amplitude: Array, distance: Array, settings: Settings) -> tuple[Array, Array]:
        """Return the variances of one frame's distance [m^2] and amplitude [counts^2]."""
        sigma = self.camera.sigma_distance(amplitude)
        by_amplitude = sigma_amplitude(sigma, amplitude, ambiguity=self.camera.noise_range)
        whole = self.camera.sigma_distance(amplitude, distance=distance, settings=settings)
        return whole**2, by_amplitude**2

    def _latent(
        self,
        station: Station,
        predicted: Array,
        n: Array,
        model: AmplitudeModel,
        pixel_gain: Array | float,
    ) -> tuple[Array, Array | float, Array | float]:
        """Return the latent amplitude: the predicted and the measured one, weighted by their variances.

        A measured amplitude carries noise that would bias coefficients (errors in variables); a predicted
        one carries the error of reflectivities. With ``tau`` -> 0 it is the prediction, with a large one
        the measurement. Also returns its relative derivatives by the prediction (through the weights as
        well) and by the measurement.
        """
        if model.tau == 0.0:
            return predicted, 1.0, 0.0

        def share_at(amplitude: Array) -> Array:
            noise = 2 * np.pi / self.camera.noise_range * self.camera.sigma_distance(amplitude)
            rounding = rounding_of_mean((noise * amplitude) ** 2, n) / amplitude**2
            return np.asarray(model.tau**2 / (model.tau**2 + noise**2 / n + rounding))

        share = share_at(predicted)
        by_light = (share_at(predicted * (1 + _SMALL)) - share) / _SMALL
        measured = self._expanded(station.amplitude / pixel_gain) * pixel_gain
        with np.errstate(divide="ignore", invalid="ignore"):
            # a free response gives light also to the amplitude 0 of pixels without a measurement
            seen = (measured > 0) & (station.amplitude > 0)
            ratio = np.log(np.where(seen, measured / predicted, 1.0))
        ratio = np.clip(ratio, -3.0, 3.0)
        return predicted * np.exp(share * ratio), 1.0 - share + by_light * ratio, share
