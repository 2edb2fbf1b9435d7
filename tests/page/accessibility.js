// What is wrong with the page that is shown, as a list of words; run by accessibility.py.
(() => {
  const found = [];
  const seen = (e) => e.checkVisibility({ checkOpacity: true, checkVisibilityCSS: true }) && e.getClientRects().length;
  const told = (e) => `${e.tagName.toLowerCase()} "${(e.textContent || e.name || e.id || "").trim().slice(0, 40)}"`;
  const name = (e) => (e.getAttribute("aria-label") || e.textContent || [...(e.labels ?? [])].map((l) => l.textContent).join("")
    || (e.getAttribute("aria-labelledby") ?? "").split(" ").map((id) => document.getElementById(id)?.textContent ?? "").join("")).trim();
  for (const e of document.querySelectorAll("a[href], button, summary, [role=img], [role=region], dialog, progress, nav, ol.phases"))
    if (seen(e) && !name(e)) found.push(`without a name: ${told(e)}`);
  for (const e of document.querySelectorAll("input, select, textarea"))
    if (seen(e) && !e.labels?.length && !e.getAttribute("aria-label")) found.push(`without a label: ${told(e)}`);
  for (const e of document.querySelectorAll("[tabindex]"))
    if (e.tabIndex > 0) found.push(`takes the focus out of turn: ${told(e)}`);
  const ids = [...document.querySelectorAll("[id]")].map((e) => e.id);
  for (const id of new Set(ids)) if (ids.filter((other) => other === id).length > 1) found.push(`twice the same id: ${id}`);
  for (const what of ["main", "header", "nav", "h1"])
    if (document.querySelectorAll(what).length !== 1) found.push(`${document.querySelectorAll(what).length} of ${what}`);
  let level = 0;
  for (const e of document.querySelectorAll("main h1, main h2, main h3, main h4")) {
    const now = Number(e.tagName[1]);
    if (seen(e) && now > level + 1) found.push(`heading leaves out a level: ${told(e)}`);
    level = now;
  }
  for (const table of document.querySelectorAll("main table"))
    if (seen(table) && !table.querySelector("th[scope]")) found.push(`table without headers: ${told(table)}`);
  const parse = (text) => { const [r, g, b, a = 1] = text.match(/[\d.]+/g).map(Number); return { r, g, b, a }; };
  const light = ({ r, g, b }) => { const [x, y, z] = [r, g, b].map((v) => (v /= 255) <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4); return 0.2126 * x + 0.7152 * y + 0.0722 * z; };
  const behind = (e) => { for (let at = e; at; at = at.parentElement) { const c = parse(getComputedStyle(at).backgroundColor); if (c.a === 1) return c; } return { r: 255, g: 255, b: 255 }; };
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  for (let node = walker.nextNode(); node; node = walker.nextNode()) {
    const e = node.parentElement;
    if (!node.textContent.trim() || !seen(e) || e.closest(".visually-hidden, :disabled, noscript, option")) continue;
    const style = getComputedStyle(e), size = parseFloat(style.fontSize);
    const wanted = size >= 24 || (size >= 18.66 && Number(style.fontWeight) >= 700) ? 3 : 4.5;
    const [a, b] = [light(parse(style.color)), light(behind(e))].sort((x, y) => y - x);
    if ((a + 0.05) / (b + 0.05) < wanted) found.push(`contrast ${((a + 0.05) / (b + 0.05)).toFixed(2)}: ${told(e)}`);
  }
  return [...new Set(found)];
})()
