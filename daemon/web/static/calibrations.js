// The calibrations and the chain of zeros.

import { STACK, at, below, el, getJson, t, table, timeElement, withSigma } from "./page.js";

const section = document.getElementById("calibrations");
const datumSection = document.getElementById("datum");

const showCalibrations = async () => {
  const { calibrations } = await getJson("/api/calibrations");
  const rows = calibrations.map((entry) => [
    el("a", { href: at(`/calibrations/${entry.id}`) }, `${entry.id}`), timeElement(entry.created), entry.method,
    entry.passed ? t("yes") : el("span", { class: "flag flag-4" }, t("no")), entry.active ? t("active") : ""]);
  below(section, rows.length
    ? table(t("heading_calibrations"), [t("calibration"), t("created"), t("method"), t("passed"), t("state_word")], rows, STACK)
    : el("p", {}, t("none")));
};

const showDatum = async () => {
  const { datum } = await getJson("/api/datum");
  const rows = datum.map((link) => [
    el("a", { href: at(`/calibrations/${link.calibration}`) }, `${link.calibration}`), timeElement(link.reference), t(`datum_${link.method}`),
    withSigma(link.x_mm, link.sigma_x_mm), withSigma(link.y_mm, link.sigma_y_mm), t(link.holds ? "holds" : "replaced"), link.detail]);
  below(datumSection, el("p", { class: "hint" }, t("datum_hint")), rows.length
    ? table(t("heading_datum"), [t("calibration"), t("reference"), t("method"), t("right_mm"), t("up_mm"), t("state_word"), t("detail")], rows, STACK)
    : el("p", {}, t("none")));
};

const tried = (node, show) => show().catch((error) =>
  below(node, el("p", { class: "notice", role: "alert" }, t("failed", { text: error.message }))));

await Promise.all([tried(section, showCalibrations), tried(datumSection, showDatum)]);
section.dataset.state = "ready";
