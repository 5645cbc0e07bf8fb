for (const slider of document.querySelectorAll(".slider")) {
  const range = slider.querySelector("input");
  range.addEventListener("input", () => slider.style.setProperty("--at", range.value + "%"));
}
for (const view of document.querySelectorAll(".view")) {
  const slider = view.querySelector(".slider"), choose = view.querySelector(".choose");
  const figures = [...view.querySelectorAll("figure[data-label]")];
  const pictures = {left: slider.querySelector(".top img"), right: slider.querySelector(":scope > img")};
  if (figures.length < 3) continue;
  for (const side of ["left", "right"]) {
    const label = slider.querySelector("em." + side), select = document.createElement("select");
    select.setAttribute("aria-label", side + " picture");
    for (const figure of figures) {
      const option = document.createElement("option");
      option.textContent = figure.dataset.label;
      option.selected = figure.dataset.label === label.textContent;
      select.append(option);
    }
    select.addEventListener("change", () => {
      const chosen = figures[select.selectedIndex];
      pictures[side].src = chosen.querySelector("img").src;
      label.textContent = chosen.dataset.label;
    });
    choose.append(side + " ", select);
  }
  choose.hidden = false;
}
