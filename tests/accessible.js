// What a page must have for readers who see it badly or not at all; gives a list of what it lacks.
(() => {
  const lacks = [];
  const all = (query) => [...document.querySelectorAll(query)];
  const need = (fine, words) => { if (!fine) lacks.push(words); };
  const seen = (element) => element.checkVisibility() && !element.closest(".skip");
  need(document.documentElement.lang, "a language");
  need(document.title, "a title");
  need(all("h1").length === 1, "one first heading");
  need(all("main").length === 1, "one main part");
  const levels = all("h1, main h2, main h3").map((heading) => Number(heading.tagName[1]));
  need(levels.every((level, k) => k === 0 || level <= levels[k - 1] + 1), "headings in order");
  const ids = all("[id]").map((element) => element.id);
  need(new Set(ids).size === ids.length, "ids that stand once");
  for (const link of all("a[href^='#']")) need(document.getElementById(link.hash.slice(1)), "target " + link.hash);
  for (const name of ["aria-labelledby", "aria-describedby"]) {
    for (const element of all("[" + name + "]")) {
      for (const id of element.getAttribute(name).split(" ")) need(document.getElementById(id), "label " + id);
    }
  }
  for (const drawing of all("main svg")) {
    need(drawing.getAttribute("role") === "img" && drawing.querySelector("title, desc").textContent, "words for a drawing");
  }
  for (const picture of all("img")) need(picture.alt, "words for a picture");
  for (const table of all("table")) {
    need(table.caption && table.caption.textContent.trim(), "a caption of " + table.id);
    need([...table.querySelectorAll("th")].every((head) => head.scope), "scopes in " + table.id);
  }
  for (const control of all("a, button")) {
    const text = control.textContent.trim();
    need(text || control.ariaLabel, "a name of a control");
    need(!control.ariaLabel || control.ariaLabel.includes(text), "the visible name in " + control.ariaLabel);
  }
  for (const box of all(".scroll, .rows, .equation")) {
    const wide = box.scrollWidth > box.clientWidth || box.scrollHeight > box.clientHeight;
    need(!wide || !seen(box) || (box.tabIndex === 0 && box.ariaLabel), "a way for the keyboard into " + box.ariaLabel);
  }
  const skip = document.querySelector("a");
  need(skip.hash === "#main", "a first link to the main part");

  const channels = (text) => text.match(/[\d.]+/g).map(Number);
  const light = (colour) => {
    const [r, g, b] = colour.slice(0, 3).map((c) => c / 255).map((c) => (c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4));
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const ground = (element) => {
    for (let here = element; here; here = here.parentElement) {
      const colour = channels(getComputedStyle(here).backgroundColor);
      if (colour.length < 4 || colour[3] > 0) return light(colour);
    }
    return light([255, 255, 255]);
  };
  const contrast = (a, b) => (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
  const weak = new Set();
  for (const element of all("body *")) {
    const own = [...element.childNodes].some((node) => node.nodeType === 3 && node.textContent.trim());
    if (!own || !seen(element) || element.closest("svg, script, style")) continue;
    const ratio = contrast(light(channels(getComputedStyle(element).color)), ground(element));
    if (ratio < 4.5) weak.add(element.tagName + "." + element.className + " " + ratio.toFixed(2));
  }
  need(weak.size === 0, "contrast in " + [...weak].slice(0, 5).join(", "));
  for (const drawing of all("main svg")) {  // its letters
    const ratio = contrast(light(channels(getComputedStyle(drawing).color)), ground(drawing));
    need(ratio >= 4.5, "contrast of letters in " + drawing.getAttribute("aria-labelledby"));
  }
  for (const line of all("svg path, svg use")) {
    const style = getComputedStyle(line);
    if (!seen(line) || style.stroke === "none" || !/--(?!grid|paper)/.test(line.getAttribute("style") || "")) continue;
    const ratio = contrast(light(channels(style.stroke)), ground(line.closest(".drawing")));
    if (ratio < 3) weak.add(line.getAttribute("style") + " " + ratio.toFixed(2));
  }
  need(weak.size === 0, "contrast of lines in " + [...weak].slice(0, 5).join(", "));
  return lacks;
})()
